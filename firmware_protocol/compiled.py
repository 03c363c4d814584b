"""How the loops over events and bits are compiled by numba.

kernel     a loop that other compiled code calls: arrays belong to the caller, so no reference is counted
entry_of   of a folder, for a function that Python calls. Only entries are cached on disk, valid while no module of
           the folder changes
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from numba import njit

from firmware_protocol.numba_cache import checksum_of, valid_for

__all__ = ["entry_of", "kernel"]

_Function = TypeVar("_Function", bound=Callable[..., Any])

_COUNTED: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_UNCOUNTED: dict[str, Any] = {**_COUNTED, "_nrt": False}


def kernel(function: _Function) -> _Function:
    """Compile `function` for compiled callers."""
    compiled: _Function = njit(**_UNCOUNTED)(function)
    return compiled


def entry_of(folder: Path) -> Callable[[_Function], _Function]:
    """Return the decorator that compiles functions of `folder` for Python callers.

    With NUMBA_DISABLE_JIT it leaves them as they are.
    """
    sources = checksum_of(folder)

    def entry(function: _Function) -> _Function:
        dispatcher: Any = njit(cache=True, **_COUNTED)(function)
        if dispatcher is function:
            return function
        compiled: _Function = valid_for(sources, dispatcher)
        return compiled

    return entry
