"""Pictures for people: the light dimmed, ON events green, OFF events red, as 8-bit sRGB."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from emulator.light import Light, MachineLacks, SceneError
from firmware_protocol.events import Events

__all__ = ["Rgb", "event_picture", "save_png"]

Rgb = npt.NDArray[np.uint8]
"""(height, width, 3), row 0 on top."""

_ON = (0, 255, 0)
_OFF = (255, 0, 0)


def event_picture(light: Light, events: Events, *, white: float | None = None, dimming: float = 0.25) -> Rgb:
    """Draw events over the light in which they arose.

    Parameters
    ----------
    light : (height, width) float32, linear.
    events : (n,) EVENT, sorted by time; where a pixel has several the last is seen.
    white
        The light drawn as full white; the brightest of the picture unless given.
    dimming
        Share of the screen's levels that white is drawn with; 1 shows the light alone at its best.

    Raises
    ------
    ValueError
        Events outside the picture.
    """
    height, width = light.shape
    if len(events) and (events["x"].max() >= width or events["y"].max() >= height):
        raise ValueError(f"there are events outside the {width} x {height} picture: it belongs to another sensor")
    top = float(light.max()) if white is None else white
    grey = _srgb(np.clip(light / top, 0.0, 1.0) if top > 0 else np.zeros_like(light))
    picture = np.repeat(np.rint(255 * dimming * grey).astype(np.uint8)[:, :, None], 3, axis=2)
    picture[events["y"], events["x"]] = np.where(events["on"][:, None], _ON, _OFF)
    return picture


def save_png(path: Path, rgb: Rgb) -> None:
    """Write a picture as PNG; needs pillow."""
    try:
        from PIL import Image
    except ImportError as error:
        raise MachineLacks("writing pictures needs pillow: pip install 'evstim[report]'") from error
    try:
        Image.fromarray(rgb).save(path, "PNG")
    except OSError as error:
        raise SceneError(f"the picture {path} cannot be written: {error.strerror or error}") from error


def _srgb(linear: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Encode linear light 0 to 1 for a screen (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** np.float32(1 / 2.4) - 0.055)
