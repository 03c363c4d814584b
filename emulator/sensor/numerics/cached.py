"""Entries, what Python calls of compiled code, kept on disk as long as no source of the sensor changes.

As `compiled.entry`, but without its last argument. That argument is left out in every call, and numba tells one
left-out number from another by identity: of several functions with such an argument, all but the first have their types
worked out anew in each call, 50 to 200 us a time (numba issue 6173). Here the checksum of the sources stands where
numba notes how fresh the code is.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

__all__ = ["kept_entry"]

_SENSOR = Path(__file__).parent.parent
_SOURCES = zlib.crc32(b"".join(path.read_bytes() for path in sorted(_SENSOR.rglob("*.py"))))


def kept_entry(function: Callable[..., Any]) -> Any:
    """Compile `function` as an entry; its code on disk is current while all modules of the sensor are unchanged."""
    dispatcher: Any = njit(nogil=True, error_model="numpy", cache=True)(function)
    on_disk = dispatcher._cache._cache_file
    on_disk._source_stamp = (on_disk._source_stamp, _SOURCES)
    return dispatcher
