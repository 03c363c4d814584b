"""The decorator of the kernels of this folder, cached on disk as long as none of its sources changes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

from emulator import raster
from firmware_protocol.numba_cache import checksum_of, valid_for

__all__ = ["entry"]

_SOURCES = checksum_of(Path(__file__).parent) ^ checksum_of(Path(raster.__file__).parent)


def entry(function: Callable[..., Any]) -> Any:
    """Compile `function` for calls from Python; it releases the GIL."""
    return valid_for(_SOURCES, njit(nogil=True, error_model="numpy", cache=True)(function))
