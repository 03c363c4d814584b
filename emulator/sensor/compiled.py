"""How the sensor's loops are compiled by numba, and why so.

    kernel                  plain loops over arrays that the caller owns
    vector_kernel           the same, for loops that must become vectors
    lane                    arithmetic on numbers, for use inside such loops; inlined, however long: one call that is
                            left in a loop keeps it from becoming vectors
    kernel_that_allocates   may make arrays
    entry                   what Python calls; the only kind whose compiled code is kept on disk

Two options decide whether a loop is fast; each cost a factor of 20 to 40 here before it was found:

- error_model="numpy": a division by zero gives inf or NaN. In the Python model it raises, so that a loop with a
  division has an early exit, and no such loop becomes vectors.
- _nrt=False: no reference counting. Otherwise passing an array to a helper counts a reference up and down with atomic
  operations, and numba leaves them in the loop when the helper has more than one way out: 80 ns a call instead of 2.

And fastmath contracts a*b + c to one rounding and does nothing else: NaN and infinity keep their meaning, and sums
their order.

numba takes code on disk for current while the file of *that* function is unchanged, and does not look at the helpers
compiled into it. Hence only entries are kept, each with a last argument `sources: int = SOURCES` that nobody passes:
its default is part of the key on disk, so that a change of any of these files compiles anew.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from numba import njit

__all__ = [
    "SOURCES", "Real", "entry", "kernel", "kernel_that_allocates", "lane", "say_if_not_compiled", "vector_kernel",
]  # fmt: skip

_LOG = logging.getLogger(__name__)
_Function = TypeVar("_Function", bound=Callable[..., Any])
_Decorator = Callable[[_Function], _Function]

Real = Any
"""A float of any width: inside numba, whichever the caller has."""

_COMMON: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_UNCOUNTED: dict[str, Any] = {**_COMMON, "_nrt": False}
_FILES = (
    "compiled", "elementary", "layout", "lowpass", "trust", "events", "pieces", "candidates", "kernels", "readout",
)  # fmt: skip

SOURCES = zlib.crc32(b"".join((Path(__file__).parent / f"{name}.py").read_bytes() for name in _FILES))
"""Checksum of the files that hold kernels."""

kernel: _Decorator[Any] = njit(**_UNCOUNTED)
vector_kernel: _Decorator[Any] = njit(**_UNCOUNTED, fastmath={"contract"})
lane: _Decorator[Any] = njit(**_UNCOUNTED, fastmath={"contract"}, forceinline=True)
kernel_that_allocates: _Decorator[Any] = njit(**_COMMON)
entry: _Decorator[Any] = njit(**_COMMON, cache=True)


def say_if_not_compiled(function: Callable[..., Any], what: str) -> None:
    """Log (for debugging; runs say it when it takes long) that `function` is about to be compiled or loaded."""
    if not getattr(function, "signatures", True):
        _LOG.debug("compiling %s: takes some seconds once, and is kept on disk for the next run", what)
