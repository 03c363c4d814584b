"""How fast the pixel step is: full physics of the DAVIS346 preset, one thread, 1 ms steps, sorted event list included.

Timed is `PixelArray.step` alone, call by call; the picture is written into one buffer before each call, as a renderer
would. The figure is the pixels of the sensor over the median time of a step.

    quiet    still light, a different level at each pixel; nothing fires
    5 pct    a sine grating in log light, oblique, 40 pixels to a period, drifting at the speed that makes 5 % of the
             pixels fire in each step: every pixel's light changes in every step, rising, turning and falling
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from emulator.sensor.pixels import PixelArray
from emulator.sensor.presets import PRESETS, SensorParameters

__all__ = ["FiringRun", "firing", "pixel_5pct", "pixel_quiet"]

_STEP_NS = 1_000_000
_WARM_UP = 50
_STEPS = 400
_PICTURES = 40
_PERIOD_PX = 40.0
_CONTRAST = 1.0  # amplitude of the grating, ln units

_Light = npt.NDArray[np.float32]


@dataclasses.dataclass(frozen=True)
class FiringRun:
    """What a workload did: Mpixel/s and Mev/s of the median step, and the share of pixels that fired in a step."""

    mpixel_s: float
    mev_s: float
    share: float


def _grating(parameters: SensorParameters, phase: float) -> _Light:
    """Return the grating, (height, width) float32, its logarithm a sine around ln 0.5."""
    y, x = np.mgrid[: parameters.height, : parameters.width]
    wave = np.sin(2 * np.pi * (x + 0.5 * y) / _PERIOD_PX + phase)
    return np.asarray(0.5 * np.exp(_CONTRAST * wave), np.float32)


def _timed(array: PixelArray, picture: Callable[[int], _Light], steps: int) -> tuple[float, float]:
    """Return the median seconds of a step and the mean number of events in one."""
    light = picture(0).copy()
    array.reset(light, 0)
    seconds, events = [], 0
    for k in range(1, _WARM_UP + steps + 1):
        light[:] = picture(k)
        start = time.perf_counter()
        crossings = array.step(light, k * _STEP_NS)
        if k > _WARM_UP:
            seconds.append(time.perf_counter() - start)
            events += len(crossings)
    return statistics.median(seconds), events / steps


def firing(share: float, parameters: SensorParameters = PRESETS["davis346"], steps: int = _STEPS) -> FiringRun:
    """Run the drifting grating at which about `share` of the pixels fire in each step."""
    threshold = (parameters.threshold_on + parameters.threshold_off) / 2
    swing = 2 * _CONTRAST - threshold  # a threshold is spent at each turn before the first event of the other sign
    phase_step = share * threshold / swing * np.pi  # two swings in 2 pi
    count = max(2, round(2 * np.pi / phase_step))
    pictures = [_grating(parameters, -2 * np.pi * k / count) for k in range(min(count, _WARM_UP + steps + 1))]
    median_s, events = _timed(PixelArray(parameters, 1), lambda k: pictures[k % len(pictures)], steps)
    pixels = parameters.width * parameters.height
    return FiringRun(pixels / median_s / 1e6, events / median_s / 1e6, events / pixels)


def pixel_quiet() -> float:
    """Return Mpixel/s of a step in which nothing fires (no leak, so that nothing does), 346 x 260."""
    parameters = dataclasses.replace(PRESETS["davis346"], leak_hz=0.0)
    still = _grating(parameters, 0.0)
    median_s, _ = _timed(PixelArray(parameters, 1), lambda k: still, _STEPS)
    return still.size / median_s / 1e6


def pixel_5pct() -> float:
    """Return Mpixel/s of a step in which 5 % of the pixels fire, 346 x 260."""
    return firing(0.05).mpixel_s
