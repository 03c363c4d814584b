"""Compiler options of the sensor's numba loops, and the reasons for them.

    kernel                  plain loops over arrays that the caller owns
    vector_kernel           the same, for loops that must become vectors
    lane                    arithmetic on numbers inside such loops; always inlined: one call in a loop prevents vectors
    kernel_that_allocates   loops that may allocate arrays
    inlined                 index arithmetic that callers take over before types are known; never compiled alone

A counter that is passed to another kernel starts at NONE. numba gives a literal 0 a type of its own, and compiles
everything that gets it twice: once for Literal[int](0), once for int64. That was half of the time for compiling.

Two options decide whether a loop is fast; without them loops here were 20 to 40 times slower:

- error_model="numpy": a division by zero gives inf or NaN. In the Python model it raises, so that a loop with a
  division has an early exit, and no such loop becomes vectors.
- _nrt=False: no reference counting. Otherwise passing an array to a helper counts a reference up and down with atomic
  operations, and numba leaves them in the loop when the helper has more than one way out: 80 ns a call instead of 2.

fastmath only contracts a*b + c to one rounding, for every processor alike (`firmware_protocol.compiled`): NaN and
infinity keep their meaning, and sums their order.

Only the functions that Python calls, the entries, are cached on disk, as long as no source of the sensor changes. An
entry must not have an optional argument. numba compares omitted numbers by identity: of several functions with such an
argument, all but the first have their types resolved again in each call, 50 to 200 us each time (numba issue 6173).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numba import njit

from firmware_protocol.compiled import KernelCompiler, entry_of

_LOG = logging.getLogger(__name__)
_Function = TypeVar("_Function", bound=Callable[..., Any])
_Decorator = Callable[[_Function], _Function]

Real = Any
"""A float of any width: inside numba, that of the caller."""

NONE: Any = np.int64(0)
"""Start of a counter; see above."""

_COMMON: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_UNCOUNTED: dict[str, Any] = {**_COMMON, "_nrt": False}
kernel: _Decorator[Any] = njit(**_UNCOUNTED)
_FUSED: dict[str, Any] = {**_UNCOUNTED, "fastmath": {"contract"}, "pipeline_class": KernelCompiler}
vector_kernel: _Decorator[Any] = njit(**_FUSED)
lane: _Decorator[Any] = njit(**_FUSED, forceinline=True)
inlined: _Decorator[Any] = njit(**_UNCOUNTED, inline="always")
kernel_that_allocates: _Decorator[Any] = njit(**_COMMON)

SOURCES = ("emulator.sensor", "firmware_protocol.device.clock")
"""Sources of every entry of the sensor, as `entry_of` takes them."""

cached_entry: _Decorator[Any] = entry_of(*SOURCES)
"""Compile a function as an entry."""

cached_kernel: _Decorator[Any] = entry_of(*SOURCES, **_UNCOUNTED)
"""Compile a function for compiled callers, as `kernel` does, and cache it on disk for them. This is for the large parts
of an entry: they can be compiled at the same time, in several processes, before it."""


def log_compilation(function: Callable[..., Any], name: str) -> None:
    """Log, at debug level, that `function` is about to be compiled or loaded; runs report it when it takes long."""
    if not getattr(function, "signatures", True):
        _LOG.debug("compiling %s: takes some seconds once, and is cached on disk for the next run", name)
