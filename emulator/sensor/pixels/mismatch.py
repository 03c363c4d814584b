"""What is drawn once for each pixel of a sensor: the same numbers as `PixelArray` has, in float64.

Every method of one seed thus has the same thresholds, leak rates and phases, and so has the truth.
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
    """Each (pixels,) float64.

    Attributes
    ----------
    on, off : thresholds, ln units.
    leak : ln units a second.
    phase : share of the ON threshold by which the first reference lies below the first light.
    """

    on: _Float64s
    off: _Float64s
    leak: _Float64s
    phase: _Float64s


def draw(parameters: SensorParameters, seed: int) -> Drawn:
    """Return what `seed` means for the pixels of a sensor."""
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
    return Drawn(on, off, rate_hz * on, uniform(seed, Purpose.LEAK_PHASE, pixel))
