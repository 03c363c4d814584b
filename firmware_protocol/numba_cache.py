"""Freshness of numba's cache on disk: code is valid as long as none of its declared sources changes.

numba by itself looks at the module of a function only, not at the modules that the function calls. Here a checksum of
all sources is part of the version that numba compares before it reads a cached index. An index of other sources is
ignored unread, so it may name types that exist no more. `firmware_protocol.compiled` declares the sources.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

__all__ = ["cache_folder", "checksum_of", "valid_for"]


def checksum_of(*places: Path) -> int:
    """Return the checksum of Python sources: of modules, and of all in folders and below them."""
    files = {file for place in places for file in (place.rglob("*.py") if place.is_dir() else (place,))}
    return zlib.crc32(b"".join(file.read_bytes() for file in sorted(files)))


def cache_folder(dispatcher: Any) -> Path:
    """Return the folder of a dispatcher's code on disk."""
    return Path(dispatcher._cache.cache_path)


def valid_for(checksum: int, dispatcher: Any) -> Any:
    """Return a dispatcher of numba, compiled with `cache=True`, whose code on disk is valid for that checksum alone."""
    index = dispatcher._cache._cache_file
    index._version = f"{index._version} {checksum}"
    return dispatcher
