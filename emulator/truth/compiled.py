"""Decorator of the entries of this folder."""

from __future__ import annotations

from firmware_protocol.compiled import entry_of

entry = entry_of("emulator.truth", "emulator.raster")
"""Compile a function for calls from Python; it releases the GIL."""
