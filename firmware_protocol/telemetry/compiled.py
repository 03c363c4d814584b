"""How the loops over events and bits are compiled by numba.

kernel   a loop that other compiled code calls: arrays belong to the caller, so no reference is counted
entry    what Python calls. Only that is kept on disk, and it is current while no module of this folder changes:
         numba by itself looks at the entry's own module only
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from numba import njit

__all__ = ["entry", "kernel"]

_Function = TypeVar("_Function", bound=Callable[..., Any])

_COUNTED: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_UNCOUNTED: dict[str, Any] = {**_COUNTED, "_nrt": False}
_SOURCES = zlib.crc32(b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))))


def kernel(function: _Function) -> _Function:
    """Compile `function` for compiled callers."""
    compiled: _Function = njit(**_UNCOUNTED)(function)
    return compiled


def entry(function: _Function) -> _Function:
    """Compile `function` for Python callers; with NUMBA_DISABLE_JIT leave it as it is."""
    dispatcher: Any = njit(cache=True, **_COUNTED)(function)
    if dispatcher is function:
        return function
    on_disk = dispatcher._cache._cache_file
    on_disk._source_stamp = (on_disk._source_stamp, _SOURCES)
    compiled: _Function = dispatcher
    return compiled
