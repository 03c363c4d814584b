"""Heights and tags of a GeoTIFF by pillow; for a child process, see `foreign_file`.

Pillow knows the common compressions, also LZW, for which tifffile would need the large package imagecodecs.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError

from emulator.light import SceneError
from emulator.tables.text_file import shortened

__all__ = ["read_geotiff"]

_NUMBER_TAGS = {"scale": 33550, "tie": 33922}
_NODATA = 42113


def read_geotiff(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Return `heights`, `scale` and `tie` (empty where the file has none), and `nodata`, a text."""
    try:
        with warnings.catch_warnings(action="error"), Image.open(path) as image:
            tags = dict(getattr(image, "tag_v2", {}))
            found = {name: _numbers(tags.get(tag)) for name, tag in _NUMBER_TAGS.items()}
            return found | {"heights": np.array(image), "nodata": np.array(str(tags.get(_NODATA, ""))[:100])}
    except UnidentifiedImageError as error:
        raise SceneError("is not a TIFF that pillow reads") from error
    except (MemoryError, ImportError):
        raise
    except Exception as error:  # pillow answers a damaged file with whatever it ran into
        raise SceneError(f"is damaged, or too large: {shortened(error)}") from error


def _numbers(tag: object) -> npt.NDArray[np.float64]:
    return np.array(tag if isinstance(tag, tuple) else (), np.float64)
