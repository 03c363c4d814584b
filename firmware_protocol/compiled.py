"""How numba compiles loops over events, pixels and bits: the one rule for all kernels that are cached on disk.

kernel     a loop that other compiled code calls: arrays belong to the caller, so no reference is counted
entry_of   the decorator of functions that Python calls, the only ones that are cached on disk. Its arguments are the
           declared sources: every module of ours whose functions are called or whose constants are frozen in the code

numba by itself compares the module of an entry alone. A module that is missing in the declaration leaves stale code on
disk when it changes; a test walks from every entry through what it uses and compares the two.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from numba import njit

from firmware_protocol.numba_cache import checksum_of, valid_for

__all__ = ["RULE", "entry_of", "kernel", "place_of"]

_Function = TypeVar("_Function", bound=Callable[..., Any])

RULE = (__name__, "firmware_protocol.numba_cache")
"""Sources of every entry, which are not declared."""

_ROOT = Path(__file__).parents[1]
_COUNTED: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_UNCOUNTED: dict[str, Any] = {**_COUNTED, "_nrt": False}


def kernel(function: _Function) -> _Function:
    """Compile `function` for compiled callers."""
    compiled: _Function = njit(**_UNCOUNTED)(function)
    return compiled


def entry_of(*sources: str, **options: Any) -> Callable[[_Function], _Function]:
    """Return the decorator that compiles functions for Python callers, and caches them on disk.

    With NUMBA_DISABLE_JIT it leaves them as they are.

    Parameters
    ----------
    sources : names of modules, and of packages with everything below them: "emulator.raster". The code on disk is valid
        while none of them changes.
    options : of numba.njit, beside nogil=True and error_model="numpy".

    Raises
    ------
    ValueError
        There is no module or package of such a name.
    """
    checksum = _checksum(*sources, *RULE)

    def entry(function: _Function) -> _Function:
        dispatcher: Any = njit(**{**_COUNTED, **options, "cache": True})(function)
        if dispatcher is function:
            return function
        dispatcher.sources = sources
        compiled: _Function = valid_for(checksum, dispatcher)
        return compiled

    return entry


@cache
def _checksum(*sources: str) -> int:
    return checksum_of(*map(place_of, sources))


def place_of(name: str) -> Path:
    """Return the folder of a package, or the file of a module, by its name; raises ValueError."""
    folder = _ROOT.joinpath(*name.split("."))
    for place in (folder, folder.with_name(f"{folder.name}.py")):
        if place.exists():
            return place
    raise ValueError(f"{name!r} is no module or package beside {_ROOT / 'firmware_protocol'}")
