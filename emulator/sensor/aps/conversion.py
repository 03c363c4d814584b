"""From light on active pixels to samples of the converter, with their noise.

    reset read   R + n1                                   R: the reset level; n1, n2: half of the read noise each
    signal read  R - (electrons / e + pattern) + n2       electrons: Poisson; e: electrons per DN

Both are rounded and cut to 0..1023. Every random number is keyed by the pixel and the frame's start, so that a frame
does not depend on the steps in which it was exposed. Photons: mean + sqrt(mean) z + (z^2 - 1) / 6, which has a Poisson
number's first three moments but for its rounding.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.sensor.aps.parameters import FrameParameters
from emulator.sensor.numerics.keyed import Purpose, normal, root_of
from emulator.sensor.numerics.keyed_kernels import normals, streams

__all__ = ["Converter"]

_MOST = 1023

Floats = npt.NDArray[np.float32]
Samples = npt.NDArray[np.uint16]


class Converter:
    """The converter of a chip.

    Parameters
    ----------
    size
        (width, height) of the array.
    by_column
        Whether a line is a column of the user's picture; all arrays of lines are (lines, samples).
    """

    def __init__(self, parameters: FrameParameters, seed: int, size: tuple[int, int], by_column: bool) -> None:
        self._parameters = p = parameters
        self._seed = seed
        width, height = size
        pixels, columns = width * height, np.arange(width)
        fixed = p.column_pattern_dn * (1 - 2 * (columns % 2))
        fixed = fixed + p.column_fixed_dn * normal(seed, Purpose.APS_COLUMN, columns)
        gain = 1 + p.gain_spread * normal(seed, Purpose.APS_GAIN, np.arange(pixels)).reshape(height, width)
        self._by_column = by_column
        self._fixed = self._lines(np.broadcast_to(fixed.astype(np.float32), (height, width)))
        self._gain = self._lines(np.maximum(gain, 0).astype(np.float32))
        self._streams = {
            purpose: self._lines(streams(root_of(seed, purpose), pixels).reshape(height, width))
            for purpose in (Purpose.APS_RESET_NOISE, Purpose.APS_SIGNAL_NOISE, Purpose.APS_SHOT_NOISE)
        }

    def _lines(self, picture: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.ascontiguousarray(picture.T if self._by_column else picture)

    def reset(self, lines: slice, samples: slice, frame: int) -> Samples:
        """Return the reset reads of a part of the array, (lines, samples), of the frame whose number is `frame`."""
        return _converted(self._parameters.reset_dn + self._read_noise(Purpose.APS_RESET_NOISE, lines, samples, frame))

    def signal(self, light_ms: Floats, lines: slice, samples: slice, frame: int) -> Samples:
        """Return the signal reads of a part that has seen `light_ms`, (lines, samples) float32."""
        p = self._parameters
        brightness = light_ms * self._gain[lines, samples] * np.float32(p.sensitivity_dn_ms)
        if p.electrons_per_dn:
            brightness = self._photons(brightness, self._normals(Purpose.APS_SHOT_NOISE, lines, samples, frame))
        brightness += self._fixed[lines, samples]
        brightness += self._common_noise(lines, samples, frame)
        return _converted(p.reset_dn - brightness + self._read_noise(Purpose.APS_SIGNAL_NOISE, lines, samples, frame))

    def _photons(self, brightness: Floats, z: Floats) -> Floats:
        """Return brightness, DN, with its shot noise; what has no light has none."""
        e = np.float32(self._parameters.electrons_per_dn)
        mean = brightness * e
        electrons = mean + np.sqrt(mean) * z + np.where(mean > 0, (z * z - 1) / 6, 0)
        noisy: Floats = np.maximum(electrons, 0) / e
        return noisy

    def _read_noise(self, purpose: Purpose, lines: slice, samples: slice, frame: int) -> Floats:
        rms = self._parameters.read_noise_dn / math.sqrt(2)
        if not rms:
            return np.zeros(self._fixed[lines, samples].shape, np.float32)
        return self._normals(purpose, lines, samples, frame) * np.float32(rms)

    def _normals(self, purpose: Purpose, lines: slice, samples: slice, frame: int) -> Floats:
        part = np.ascontiguousarray(self._streams[purpose][lines, samples])
        drawn: Floats = normals(part.reshape(-1), frame).reshape(part.shape)
        return drawn

    def _common_noise(self, lines: slice, samples: slice, frame: int) -> Floats:
        """Return the noise of columns and rows, which broadcasts to (lines, samples)."""
        p = self._parameters
        of_lines, of_samples = (p.column_noise_dn, p.row_noise_dn)[:: 1 if self._by_column else -1]
        names = (Purpose.APS_COLUMN_NOISE, Purpose.APS_ROW_NOISE)[:: 1 if self._by_column else -1]
        along = of_lines * normal(self._seed, names[0], np.arange(lines.start, lines.stop), frame)
        across = of_samples * normal(self._seed, names[1], np.arange(samples.start, samples.stop), frame)
        return (along[:, None] + across).astype(np.float32)


def _converted(level: Floats) -> Samples:
    samples: Samples = np.clip(np.floor(level + np.float32(0.5)), 0, _MOST).astype(np.uint16)
    return samples
