"""Compiled entry points of the CPU's terrain, cached on disk as long as no source that they are made of changes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

from emulator import photometry
from firmware_protocol.numba_cache import checksum_of, valid_for

__all__ = ["entry"]

_SOURCES = checksum_of(Path(__file__).parent) ^ checksum_of(Path(photometry.__file__).parent)


def entry(function: Callable[..., Any]) -> Any:
    """Compile `function` for calls from Python, without allocation; see `numerics.compiled` for the options.

    Its code on disk is valid while terrain and photometry are unchanged.
    """
    options: dict[str, Any] = {
        "nogil": True,
        "error_model": "numpy",
        "cache": True,
        "fastmath": {"contract"},
        "_nrt": False,
    }
    compiled = njit(**options)(function)
    return valid_for(_SOURCES, compiled)
