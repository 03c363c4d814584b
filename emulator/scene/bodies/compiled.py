"""The decorator of compiled functions that Python calls: their machine code is kept on disk.

numba notices a change of the function's own module only, while these call others of this folder; here the code is valid
as long as no module of the folder changes.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

__all__ = ["entry"]

_SOURCES = zlib.crc32(b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))))


def entry(function: Callable[..., Any]) -> Any:
    """Compile `function` for calls from Python; it gives the GIL back."""
    dispatcher: Any = numba.njit(nogil=True, error_model="numpy", cache=True)(function)
    on_disk = dispatcher._cache._cache_file
    on_disk._source_stamp = (on_disk._source_stamp, _SOURCES)
    return dispatcher
