"""Decorators of the sensor's entries, which Python calls, cached on disk as long as no source of the sensor changes.

An entry must not have an optional argument. numba compares omitted numbers by identity: of several
functions with such an argument, all but the first have their types resolved again in each call, 50 to 200 us each time
(numba issue 6173).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from emulator.sensor.numerics.compiled import UNCOUNTED
from firmware_protocol.compiled import entry_of

__all__ = ["cached_entry", "cached_kernel"]

_Decorator = Callable[[Callable[..., Any]], Any]

_SOURCES = ("emulator.sensor", "firmware_protocol.device.clock")

cached_entry: _Decorator = entry_of(*_SOURCES)
"""Compiles a function as an entry."""

cached_kernel: _Decorator = entry_of(*_SOURCES, **UNCOUNTED)
"""Compiles a function for compiled callers, as `kernel` does, and caches it on disk for them.

This is for the large parts of an entry: they can be compiled at the same time, in several processes, before it.
"""
