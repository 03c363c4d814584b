"""Textures in model files: octets of PNG and JPEG become luminance, in the child process that reads the model.

    base colour                 luminance of the linear colour, at most 1024 pixels on a side, powers of two
    metallic and roughness      their mean
    places in the image         u to the right and v down, 0 to 1, by the transform that the file gives

Sources: Khronos, glTF 2.0 specification, sections 3.8 and 3.9, and KHR_texture_transform; the transfer function of
sRGB: IEC 61966-2-1.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from emulator.light import SceneError

REPEAT, CLAMP, MIRROR = 10497, 33071, 33648
WRAPS = REPEAT, CLAMP, MIRROR
"""Repetition of an image beyond its sides, of its border, and mirror images; numbers of glTF."""

MOST_PIXELS = 1 << 27  # of all images of a model: some seconds of decoding
_MOST_PIXELS = 1 << 25  # of an image
_MOST_SIDE = 1024
_LINES = 256  # of an image at a time

_Floats = npt.NDArray[np.float64]
_Image = npt.NDArray[np.float32]


def decoded(data: bytes, where: str, most_pixels: int) -> npt.NDArray[np.uint8]:
    """Return red, green and blue, (height, width, 3), of a PNG or JPEG within limits; raises SceneError."""
    from PIL import Image  # an extra; in the child process alone

    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            if image.width * image.height > min(_MOST_PIXELS, most_pixels):
                raise SceneError(
                    f"{where} has {image.width} x {image.height} pixels: at most {_MOST_PIXELS} of one image and "
                    f"{MOST_PIXELS} of all are read, {_MOST_SIDE} on a side are used; make the images smaller"
                )
            if image.mode.startswith("I"):  # 16 bit grey, which Pillow would cut off at 255
                grey = np.asarray(image) >> 8
                return np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)
            return np.asarray(image.convert("RGB"))
    except (SceneError, MemoryError):
        raise
    except Exception as error:  # noqa: BLE001 its readers raise arbitrary exceptions for a broken file
        raise SceneError(f"{where} cannot be read as PNG or JPEG ({str(error)[:80]})") from None


def base_colour(pixels: npt.NDArray[np.uint8], weights: Sequence[float]) -> _Image:
    """Return the luminance of sRGB pixels, (height, width) powers of two, with linear `weights` of red, green, blue."""
    from PIL import Image

    s = np.arange(256) / 255
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    tables = [(weight * linear).astype(np.float32) for weight in weights]
    out: _Image = np.empty(pixels.shape[:2], np.float32)
    for start in range(0, len(out), _LINES):
        part = pixels[start : start + _LINES]
        out[start : start + _LINES] = sum(table[part[:, :, k]] for k, table in enumerate(tables))
    height, width = (min(1 << max(side - 1, 0).bit_length(), _MOST_SIDE) for side in out.shape)
    if (height, width) == out.shape:
        return out
    return np.asarray(Image.fromarray(out).resize((width, height), Image.Resampling.BILINEAR))


def transformed(uv: _Floats, offset: Sequence[float], scale: Sequence[float], angle_rad: float) -> _Floats:
    """Return coordinates (n, 2) by the transform of KHR_texture_transform.

    Scale comes first; the rotation is counter-clockwise as one sees the image, whose v points down. The GLSL in the
    specification turns the other way (issue 1563 of its repository); other readers and its model of tests do as here.
    """
    u, v = uv[:, 0] * scale[0], uv[:, 1] * scale[1]
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    return np.stack([offset[0] + cosine * u + sine * v, offset[1] - sine * u + cosine * v], axis=1)
