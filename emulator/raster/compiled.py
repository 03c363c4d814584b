"""Decorators of the renderer's kernels and entries.

`lane` is here for loops as well, where they are called at one place or two: a call that is left passes the seven arrays
of `Data` as some sixty numbers, which took 8 to 20 % of the time of a light frame.
"""

from __future__ import annotations

from emulator.sensor.numerics.compiled import kernel, lane, vector_kernel
from firmware_protocol.compiled import entry_of

__all__ = ["entry", "kernel", "lane", "vector_kernel"]

entry = entry_of("emulator.raster", "emulator.sensor.numerics")
"""Compile a function for calls from Python; it releases the GIL."""
