"""Speed of the pixel step: DAVIS346 without its source follower, one thread, 1 ms steps, sorted event list included.

Timed is `PixelArray.step` alone, call by call; the frame is written into one buffer before each call, as a renderer
would. The figure is the pixels of the sensor over the median time of a step. The light comes with its time derivative,
as it does by default in a run: log light as a cubic; `line` is the same without, log light as a straight line.

    quiet    still light, a different level at each pixel; nothing fires
    5 pct    a sine grating in log light, oblique, 40 pixels to a period, drifting at the speed that makes 5 % of the
             pixels fire in each step: every pixel's light changes in every step, rising, turning and falling
    changing the same grating, moving so slowly that nothing fires in the steps that are timed
    still    a black picture of 1280 x 720 that does not change: compared with the last one, or told to be unchanged
    threads  1280 x 720 with a share of the pixels firing: how many times as fast two threads are as one
    edges    the board of sharp edges at which a pixel's light changes several times over within a step: edges of 10:1,
             blurred by 0.5 px, at 0.5 px a step; events a second of work
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from emulator.light import Region
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import PRESETS, SensorParameters

__all__ = [
    "FiringRun",
    "TwoThreads",
    "firing",
    "grating",
    "pixel_5pct",
    "pixel_5pct_line",
    "pixel_changing",
    "pixel_edges",
    "pixel_quiet",
    "pixel_quiet_line",
    "pixel_still",
    "pixel_still_compared",
]

_DAVIS = dataclasses.replace(
    PRESETS["davis346"], source_follower_hz=0.0, parasitic_hz_at_reference=0.0, leak_hz=0.1
)  # the sensor of all figures from the first on, for comparison: without its fixed pole

_STEP_NS = 1_000_000
_WARM_UP = 50
_STEPS = 400
_PERIOD_PX = 40.0
_CONTRAST = 1.0  # amplitude of the grating, ln units

_Light = npt.NDArray[np.float32]
_Frame = tuple[_Light, _Light]
"""Light and its time derivative, a second."""


@dataclasses.dataclass(frozen=True)
class FiringRun:
    """Result of a workload: Mpixel/s and Mev/s of the median step, and the share of pixels that fired in a step."""

    mpixel_s: float
    mev_s: float
    share: float


def grating(parameters: SensorParameters, phase: float, phase_step: float) -> _Frame:
    """Return the grating, its logarithm a sine around ln 0.5 that loses `phase_step` a step; (height, width) each."""
    y, x = np.mgrid[: parameters.height, : parameters.width]
    angle = 2 * np.pi * (x + 0.5 * y) / _PERIOD_PX + phase
    light = 0.5 * np.exp(_CONTRAST * np.sin(angle))
    rate = -light * _CONTRAST * np.cos(angle) * phase_step * 1e9 / _STEP_NS
    return light.astype(np.float32), rate.astype(np.float32)


def _edges(parameters: SensorParameters, k: int) -> _Frame:
    """Return light and dark stripes of 20 px with blurred edges, k steps of 0.5 px along; (height, width) each."""
    y, x = np.mgrid[: parameters.height, : parameters.width]
    sigma_px, speed_px = 0.5, 0.5
    place = (x + 0.2 * y - speed_px * k) % 40 - 10
    light, slope = np.full(x.shape, 0.1), np.zeros(x.shape)
    for edge, sign in ((0, 1), (20, -1)):
        steep = 1.702 / sigma_px  # a logistic edge of the width of a Gaussian's
        rise = 1 / (1 + np.exp(-np.clip(steep * (place - edge), -60, 60)))
        light, slope = light + 0.9 * sign * rise, slope + 0.9 * sign * steep * rise * (1 - rise)
    return light.astype(np.float32), (-slope * speed_px * 1e9 / _STEP_NS).astype(np.float32)


def _timed(
    array: PixelArray, picture: Callable[[int], _Frame], steps: int, *, line: bool, changed: Region | None = None
) -> tuple[float, float]:
    """Return the median seconds of a step and the mean number of events in one."""
    light, rate = (values.copy() for values in picture(0))
    array.reset(light, 0, None if line else rate)
    seconds, events = [], 0
    for k in range(1, _WARM_UP + steps + 1):
        light[:], rate[:] = picture(k)
        start = time.perf_counter()
        crossings = array.step(light, k * _STEP_NS, None if line else rate, changed=changed)
        if k > _WARM_UP:
            seconds.append(time.perf_counter() - start)
            events += len(crossings)
    return statistics.median(seconds), events / steps


def firing(
    share: float,
    parameters: SensorParameters = _DAVIS,
    steps: int = _STEPS,
    *,
    line: bool = False,
    threads: int = 1,
) -> FiringRun:
    """Run the drifting grating at which about `share` of the pixels fire in each step."""
    threshold = (parameters.threshold_on + parameters.threshold_off) / 2
    swing = 2 * _CONTRAST - threshold  # a threshold is spent at each turn before the first event of the other sign
    phase_step = share * threshold / swing * np.pi  # two swings in 2 pi
    count = max(2, round(2 * np.pi / phase_step))
    step = 2 * np.pi / count
    pictures = [grating(parameters, -step * k, step) for k in range(min(count, _WARM_UP + steps + 1))]
    median_s, events = _timed(
        PixelArray(parameters, 1, threads), lambda k: pictures[k % len(pictures)], steps, line=line
    )
    pixels = parameters.width * parameters.height
    return FiringRun(pixels / median_s / 1e6, events / median_s / 1e6, events / pixels)


def _quiet(*, line: bool) -> float:
    parameters = dataclasses.replace(_DAVIS, leak_hz=0.0)
    still = grating(parameters, 0.0, 0.0)
    median_s, _ = _timed(PixelArray(parameters, 1, 1), lambda k: still, _STEPS, line=line)
    return still[0].size / median_s / 1e6


def pixel_changing() -> float:
    """Return Mpixel/s of a step in which the light of all pixels changes and nothing fires, 346 x 260."""
    parameters = dataclasses.replace(_DAVIS, leak_hz=0.0)
    pictures = [grating(parameters, -1e-4 * k, 1e-4) for k in range(_WARM_UP + 100)]
    median_s, _ = _timed(PixelArray(parameters, 1, 1), lambda k: pictures[k % len(pictures)], 99, line=False)
    return pictures[0][0].size / median_s / 1e6


def _still(changed: Region | None) -> float:
    parameters = dataclasses.replace(_DAVIS, leak_hz=0.0, width=1280, height=720)
    black = np.zeros((720, 1280), np.float32)
    array = PixelArray(parameters, 1, 1)
    array.reset(black, 0, black)
    seconds = []
    for k in range(1, _WARM_UP + _STEPS):
        start = time.perf_counter()
        array.step(black, k * _STEP_NS, black, changed=changed)
        seconds.append(time.perf_counter() - start)
    return black.size / statistics.median(seconds[_WARM_UP:]) / 1e6


def pixel_still() -> float:
    """Return Mpixel/s of a black picture that the caller tells to be unchanged, 1280 x 720, nothing leaks."""
    return _still(Region(0, 0, 0, 0))


def pixel_still_compared() -> float:
    """Return Mpixel/s of the same picture where it must be compared with the last one."""
    return _still(None)


@dataclasses.dataclass(frozen=True)
class TwoThreads:
    """How many times as fast two threads are as one, with `share` of 1280 x 720 pixels firing in a step."""

    share: float

    def __call__(self) -> float:
        """Return the ratio of the median times of a step."""
        parameters = dataclasses.replace(_DAVIS, width=1280, height=720)
        one, two = (firing(self.share, parameters, 40, threads=threads).mpixel_s for threads in (1, 2))
        return two / one


def pixel_quiet() -> float:
    """Return Mpixel/s of a step in which nothing fires (no leak, so that nothing does), 346 x 260."""
    return _quiet(line=False)


def pixel_quiet_line() -> float:
    """Return the same without time derivatives."""
    return _quiet(line=True)


def pixel_5pct() -> float:
    """Return Mpixel/s of a step in which 5 % of the pixels fire, 346 x 260."""
    return firing(0.05).mpixel_s


def pixel_5pct_line() -> float:
    """Return the same without time derivatives."""
    return firing(0.05, line=True).mpixel_s


def pixel_edges() -> float:
    """Return Mev/s of steps with sharp edges moving by half a pixel, 346 x 260."""
    parameters = _DAVIS
    pictures = [_edges(parameters, k) for k in range(80)]
    median_s, events = _timed(PixelArray(parameters, 1, 1), lambda k: pictures[k % 80], 150, line=False)
    return events / median_s / 1e6
