"""Decorators of the renderer's kernels and entries."""

from __future__ import annotations

from emulator.sensor.numerics.compiled import kernel, lane, vector_kernel
from firmware_protocol.compiled import entry_of

__all__ = ["entry", "kernel", "lane", "vector_kernel"]

entry = entry_of("emulator.raster", "emulator.sensor.numerics")
"""Compile a function for calls from Python; it releases the GIL."""
