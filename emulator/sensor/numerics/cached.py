"""Compiled entry points that Python calls, cached on disk as long as no source of the sensor changes.

An entry must not have an optional argument. numba tells one omitted number from another by identity: of several
functions with such an argument, all but the first have their types resolved again in each call, 50 to 200 us each time
(numba issue 6173).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

from emulator.sensor.numerics.compiled import UNCOUNTED
from firmware_protocol.numba_cache import checksum_of, valid_for

__all__ = ["cached_entry", "cached_kernel"]

_SOURCES = checksum_of(Path(__file__).parent.parent)


def cached_entry(function: Callable[..., Any]) -> Any:
    """Compile `function` as an entry; its code on disk is valid while all modules of the sensor are unchanged."""
    return valid_for(_SOURCES, njit(nogil=True, error_model="numpy", cache=True)(function))


def cached_kernel(function: Callable[..., Any]) -> Any:
    """Compile `function` for compiled callers, as `kernel` does, and keep it on disk for them.

    This is for the large parts of an entry: they can be compiled at the same time, in several processes, before it.
    """
    return valid_for(_SOURCES, njit(**UNCOUNTED, cache=True)(function))
