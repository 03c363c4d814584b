"""Decorators of the terrain's entries."""

from __future__ import annotations

from firmware_protocol.compiled import entry_of

_SOURCES = ("emulator.scene.terrain", "emulator.photometry", "emulator.raster.layout", "emulator.sensor.numerics")

entry = entry_of(*_SOURCES, fastmath={"contract"}, _nrt=False)
"""Compile a function for calls from Python, without allocation; see `numerics.compiled` for the options."""

map_entry = entry_of(*_SOURCES, error_model="python")
"""Compile a loop over a map, which may allocate; a division by zero raises."""
