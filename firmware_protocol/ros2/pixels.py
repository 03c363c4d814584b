"""Levels of the pictures of `sensor_msgs/Image`, by its encodings.

    mono8 8UC1           a level each                 mono16 16UC1   likewise, 16 bits in the message's byte order
    rgb8 8UC3 rgba8      luminance of three levels    bgr8 bgra8     the same, the other way round
    32FC1                linear light

Source: ros2/common_interfaces, sensor_msgs/image_encodings.hpp; luminance of Rec. 709.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.ros2.messages import Image

__all__ = ["ENCODINGS", "ImageError", "levels_of"]

Levels = npt.NDArray[Any]

_MOST_PX = 1 << 23
_RGB = np.array([0.2126, 0.7152, 0.0722], np.float32)
# name: type of a number, numbers of a pixel, whether blue comes first
ENCODINGS = {
    "mono8": ("u1", 1, False), "8UC1": ("u1", 1, False), "mono16": ("u2", 1, False), "16UC1": ("u2", 1, False),
    "rgb8": ("u1", 3, False), "8UC3": ("u1", 3, False), "rgba8": ("u1", 4, False),
    "bgr8": ("u1", 3, True), "bgra8": ("u1", 4, True), "32FC1": ("f4", 1, False),
}  # fmt: skip
"""Encodings that are read."""


class ImageError(ValueError):
    """A picture is not what its message says; the text is a kind of mistake, so that equal ones can be counted."""


def levels_of(image: Image) -> Levels:
    """Return (height, width) uint8, uint16 or float32 of a picture; raises ImageError."""
    if image.encoding not in ENCODINGS:
        raise ImageError("encoding not known")
    form, channels, is_bgr = ENCODINGS[image.encoding]
    pixels = _pixels(image, np.dtype(form).newbyteorder(">" if image.is_bigendian else "<"), channels)
    if channels > 1:
        rgb = pixels[:, :, 2::-1] if is_bgr else pixels[:, :, :3]
        luminance: Levels = np.rint(rgb.astype(np.float32) @ _RGB).astype(np.uint8)
        return luminance
    levels = pixels[:, :, 0].astype(form)
    if form == "f4" and not bool(np.all(np.isfinite(levels) & (levels >= 0))):
        raise ImageError("light that is negative or not finite")
    return levels


def _pixels(image: Image, form: np.dtype[Any], channels: int) -> npt.NDArray[Any]:
    """Return (height, width, channels), a view of the message."""
    width, height = image.size
    row = width * channels * form.itemsize
    data = memoryview(image.data).cast("B")
    if not 0 < width * height <= _MOST_PX:
        raise ImageError("no pixels, or too many")
    if image.step < row or image.step * height != len(data):
        raise ImageError("size and data do not agree")
    rows = np.frombuffer(data, np.uint8).reshape(height, image.step)[:, :row]
    return np.ascontiguousarray(rows).view(form).reshape(height, width, channels)
