"""The decorator of the compiled laws of reflection, cached on disk as long as no source of this folder changes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

from firmware_protocol.numba_cache import checksum_of, valid_for

__all__ = ["entry"]

_SOURCES = checksum_of(Path(__file__).parent)


def entry(function: Callable[..., Any]) -> Any:
    """Compile `function` for calls from Python and from other compiled code; it releases the GIL."""
    return valid_for(_SOURCES, njit(nogil=True, error_model="numpy", cache=True)(function))
