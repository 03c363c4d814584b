"""Decorators of the light of bodies.

Kernels and most entries count no references and so cannot allocate: with it shadow polygons took nearly twice as long.
"""

from __future__ import annotations

from firmware_protocol.compiled import entry_of, kernel

__all__ = ["entry", "kernel"]

_SOURCES = ("emulator.scene.bodies", "emulator.photometry")

entry = entry_of(*_SOURCES, _nrt=False)
"""Compile a function for calls from Python; it releases the GIL."""
