"""Decorators of numba kernels: the only import of this folder from elsewhere in the emulator.

`entry` is for functions that Python calls. Their machine code is cached on disk and is valid while no module of this
folder changes; numba by itself looks at the entry's own module only.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

from emulator.sensor.numerics.compiled import kernel, lane, vector_kernel

__all__ = ["entry", "kernel", "lane", "vector_kernel"]

_SOURCES = zlib.crc32(b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py"))))


def entry(function: Callable[..., Any]) -> Any:
    """Compile `function` for calls from Python, cached on disk until a module of this folder changes."""
    dispatcher: Any = njit(nogil=True, error_model="numpy", cache=True)(function)
    on_disk = dispatcher._cache._cache_file
    on_disk._source_stamp = (on_disk._source_stamp, _SOURCES)
    return dispatcher
