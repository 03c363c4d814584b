"""Thresholds, leak rates and leak phases of each pixel: the numbers of `PixelArray`, in float64.

All methods and the truth draw them here, so that with one seed all have the same pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.keyed import Purpose, normal, uniform
from emulator.sensor.presets import SensorParameters

__all__ = ["Drawn", "draw"]

_LEAST_THRESHOLD = 0.1  # of the nominal one, however far the mismatch would go

_Float64s = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Drawn:
    """Figures drawn once for each pixel.

    Attributes
    ----------
    on, off : (pixels,) float64
        Thresholds, ln units.
    leak : (pixels,) float64
        Leak, ln units per second.
    phase : (pixels,) float64
        Share of the ON threshold by which the first reference lies below the first light; 0 without `random_start`.
    """

    on: _Float64s
    off: _Float64s
    leak: _Float64s
    phase: _Float64s


def draw(parameters: SensorParameters, seed: int) -> Drawn:
    """Return the figures of a sensor's pixels for a seed."""
    pixel = np.arange(parameters.width * parameters.height)
    on, off = (
        nominal * np.maximum(1 + parameters.mismatch * normal(seed, purpose, pixel), _LEAST_THRESHOLD)
        for purpose, nominal in (
            (Purpose.THRESHOLD_ON, parameters.threshold_on),
            (Purpose.THRESHOLD_OFF, parameters.threshold_off),
        )
    )
    sigma = parameters.leak_spread
    rate_hz = parameters.leak_hz * np.exp(sigma * normal(seed, Purpose.LEAK_RATE, pixel) - sigma**2 / 2)
    phase = uniform(seed, Purpose.LEAK_PHASE, pixel) if parameters.random_start else np.zeros(pixel.size)
    return Drawn(on, off, rate_hz * on, phase)
