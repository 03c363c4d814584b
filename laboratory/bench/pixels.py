"""Speed of the pixel step: DAVIS346 without its source follower, one thread, 1 ms steps, sorted event list included.

Only `PixelArray.step` is timed, call by call; the frame is written into one buffer before each call, as a renderer
would do. The result is the pixels of the sensor over the median time of a step. The light comes with its time
derivative, as it does by default in a run: log light as a cubic; `line` is the same without, log light as a straight
line.

    quiet    still light, a different level at each pixel; nothing fires
    5 pct    a sine grating in log light, oblique, 40 pixels to a period, drifting at the speed that makes 5 % of the
             pixels fire in each step: every pixel's light changes in every step, rising, turning and falling
    changing the same grating, moving so slowly that nothing fires in the steps that are timed
    still    a black light frame of 1280 x 720 that does not change: compared with the last one, or reported unchanged
    threads  1280 x 720 with a share of the pixels firing: the speed of two threads over that of one
    edges    the board of sharp edges at which a pixel's light changes several times over within a step: edges of 10:1,
             blurred by 0.5 px, at 0.5 px a step; events a second of work

Noise: the time that it adds to a step of 346 x 260 pixels and 1 ms, in microseconds. The light is still and dim, 0.05
of the reference, and all pixels leak a little; the noise has the rms at which it makes the wanted number of events.
Steps with noise and without are timed in turns; results are medians over means of 64 steps.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from emulator.light import LightFrame, Region
from emulator.sensor.noise.law import corner_hz, still_hz
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import PRESETS, SensorParameters
from emulator.sensor.sensor import Sensor
from firmware_protocol.events import Float32s

_DAVIS = dataclasses.replace(
    PRESETS["davis346"], source_follower_hz=0.0, parasitic_hz_at_reference=0.0, leak_hz=0.1, noise=NoiseParameters()
)  # the sensor of all earlier measurements, for comparison: without its fixed pole and noise

_WITHOUT_LEAK = dataclasses.replace(_DAVIS, leak_hz=0.0)

_STEP_NS = 1_000_000
_WARM_UP = 50
_STEPS = 400
_PERIOD_PX = 40.0
_CONTRAST = 1.0  # amplitude of the grating, ln units

_Frame = tuple[Float32s, Float32s]
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
    array.reset(LightFrame(0, light, None if line else rate))
    seconds, events = [], 0
    for k in range(1, _WARM_UP + steps + 1):
        light[:], rate[:] = picture(k)
        start = time.perf_counter()
        crossings = array.step(LightFrame(k * _STEP_NS, light, None if line else rate, changed=changed))
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
    swing = 2 * _CONTRAST - threshold  # after each turn, the first threshold gives no event of the other sign
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
    at_rest = grating(_WITHOUT_LEAK, 0.0, 0.0)
    median_s, _ = _timed(PixelArray(_WITHOUT_LEAK, 1, 1), lambda k: at_rest, _STEPS, line=line)
    return at_rest[0].size / median_s / 1e6


def pixel_changing(parameters: SensorParameters = _WITHOUT_LEAK) -> float:
    """Return Mpixel/s of a step in which the light of all pixels changes and none fires by it, 346 x 260."""
    pictures = [grating(parameters, -1e-4 * k, 1e-4) for k in range(_WARM_UP + 100)]
    median_s, _ = _timed(PixelArray(parameters, 1, 1), lambda k: pictures[k % len(pictures)], 99, line=False)
    return pictures[0][0].size / median_s / 1e6


def still(changed: Region | None, parameters: SensorParameters = _WITHOUT_LEAK) -> float:
    """Return Mpixel/s of a black light frame, 1280 x 720, of which the caller reports that part as changed."""
    black = np.zeros((720, 1280), np.float32)
    array = PixelArray(dataclasses.replace(parameters, width=1280, height=720), 1, 1)
    array.reset(LightFrame(0, black, black))
    seconds = []
    for k in range(1, _WARM_UP + _STEPS):
        start = time.perf_counter()
        array.step(LightFrame(k * _STEP_NS, black, black, changed=changed))
        seconds.append(time.perf_counter() - start)
    return black.size / statistics.median(seconds[_WARM_UP:]) / 1e6


def pixel_still() -> float:
    """Return Mpixel/s of a black light frame that the caller reports as unchanged, 1280 x 720, nothing leaks."""
    return still(Region(0, 0, 0, 0))


def pixel_still_compared() -> float:
    """Return Mpixel/s of the same light frame where it must be compared with the last one."""
    return still(None)


@dataclasses.dataclass(frozen=True)
class TwoThreads:
    """Speed of two threads over that of one, with `share` of 1280 x 720 pixels firing in a step."""

    share: float

    def __call__(self) -> float:
        """Return the ratio of the median times of a step."""
        parameters = dataclasses.replace(_DAVIS, width=1280, height=720)
        one, two = (firing(self.share, parameters, 40, threads=threads).mpixel_s for threads in (1, 2))
        return two / one


def pixel_quiet() -> float:
    """Return Mpixel/s of a step in which nothing fires (without leak), 346 x 260."""
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


_LIGHT = 0.05
_NOISE_STEPS, _BLOCKS = 64, 25
_SEED = 1
_REFRACTORY_US = 5000.0


def noisy_sensor(events_hz: float) -> SensorParameters:
    """Return the DAVIS346 with noise that makes about `events_hz` events a pixel and second in the bench's light."""
    low, high = 0.01, 0.3
    while high / low > 1.001:
        p = _with_rms(math.sqrt(low * high))
        is_less = sum(still_hz(dataclasses.replace(p, leak_hz=0.0), float(corner_hz(p, _LIGHT)))) < events_hz
        low, high = (p.noise.rms, high) if is_less else (low, p.noise.rms)
    return _with_rms(low)


def _with_rms(noise_rms: float) -> SensorParameters:
    noise = NoiseParameters(rms=noise_rms)
    # A refractory period longer than the noise's time constant: the rate is soon that of the law.
    return dataclasses.replace(PRESETS["davis346"], noise=noise, leak_hz=0.1, refractory_us=_REFRACTORY_US)


@dataclass(frozen=True)
class NoiseLoad:
    """Cost that noise of about `events_hz` events a pixel and second adds to a step, microseconds, or by what factor.

    "pixels": to that of the array; "sensor": with the read-out; "factor": of the sensor, where light changes in all
    pixels by so little that nothing fires but noise and leak.
    """

    events_hz: float
    of: Literal["pixels", "sensor", "factor"] = "pixels"

    def __call__(self) -> float:
        """Return it."""
        make = PixelArray if self.of == "pixels" else Sensor
        noisy_s, quiet_s = _medians(make, self.events_hz, 1e-4 if self.of == "factor" else 0.0)
        return noisy_s / quiet_s if self.of == "factor" else (noisy_s - quiet_s) * 1e6


def _medians(make: type[Sensor | PixelArray], events_hz: float, flicker: float) -> tuple[float, float]:
    """Return the seconds of a step with noise and without, in light that all pixels see change by that share."""
    p, t_ns, means = noisy_sensor(events_hz), 0, []
    light = np.full((p.height, p.width), _LIGHT, np.float32)
    both = make(p, _SEED), make(_with_rms(0.0), _SEED)
    for one in both:
        one.reset(LightFrame(0, light))
    for _ in range(_BLOCKS + 1):
        spent_s = np.zeros(2)
        for _ in range(_NOISE_STEPS):
            t_ns += _STEP_NS
            light.fill(_LIGHT * (1 + flicker * (t_ns // _STEP_NS % 2)))
            for k, one in enumerate(both):
                begun_s = time.perf_counter()
                (one.expose if isinstance(one, Sensor) else one.step)(LightFrame(t_ns, light))
                spent_s[k] += time.perf_counter() - begun_s
        means.append(spent_s / _NOISE_STEPS)
    noisy_s, quiet_s = np.median(means[1:], axis=0)
    return float(noisy_s), float(quiet_s)
