"""Pictures for programs: light as linear grey levels in a PNG file."""

from __future__ import annotations

import io

import numpy as np

from emulator.light import Light, MachineLacks
from transports.needs import install_command

__all__ = ["check_png", "grey_png"]

_FASTEST = 1  # of zlib's levels: three times as fast as the default, files a tenth longer


def check_png() -> None:
    """Raise MachineLacks where pillow is not installed."""
    try:
        import PIL.Image  # noqa: F401
    except ImportError as error:
        raise MachineLacks(f"writing pictures needs pillow: {install_command('report')}") from error


def grey_png(light: Light, white: float) -> bytes:
    """Return the light, (height, width), as an 8-bit grey PNG, linear from 0 to `white`; what is brighter is white."""
    from PIL import Image

    grey = np.rint(np.clip(light * (255.0 / white), 0.0, 255.0)).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(grey).save(file, "PNG", compress_level=_FASTEST)
    return file.getvalue()
