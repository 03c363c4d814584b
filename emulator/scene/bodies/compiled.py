"""Decorator of the entries of the light of bodies."""

from __future__ import annotations

from firmware_protocol.compiled import entry_of

__all__ = ["entry"]

entry = entry_of("emulator.scene.bodies", "emulator.photometry")
"""Compile a function for calls from Python; it releases the GIL."""
