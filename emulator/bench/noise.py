"""Cost of point-process noise in a step of 346 x 260 pixels and 1 ms: microseconds, one thread.

The light is still and dim, 0.05 of the reference, and all pixels leak a little; the noise has the rms at which it makes
the wanted number of events. Each step of the noise is timed alone, right after the pixels' own, so that it finds the
caches as in a run; a window of the noise spans 16 steps or so, hence figures are medians over means of 64 steps. With
read-out it is whole sensors, with noise and without, step by step in turns.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from emulator.sensor.effects import NoiseParameters
from emulator.sensor.noise.law import corner_hz, of_array
from emulator.sensor.noise.point_process import NoiseEvents
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.mismatch import draw
from emulator.sensor.presets import PRESETS, SensorParameters
from emulator.sensor.sensor import Sensor

__all__ = ["NoiseLoad", "NoiseShare", "noisy_sensor"]

_STEP_NS = 1_000_000
_LIGHT = 0.05
_STEPS, _BLOCKS = 64, 25
_SEED = 1


def noisy_sensor(events_hz: float) -> SensorParameters:
    """Return the DAVIS346 with noise that makes about `events_hz` events a pixel and second in the bench's light."""
    low, high = 0.01, 0.3
    while high / low > 1.001:
        p = _with_rms(math.sqrt(low * high))
        law = of_array(p, (p.threshold_on + p.threshold_off) / 2, corner_hz(p, _LIGHT))
        made_hz = float(law.on + law.off)
        low, high = (p.noise.rms, high) if made_hz < events_hz else (low, p.noise.rms)
    return _with_rms(low)


def _with_rms(noise_rms: float) -> SensorParameters:
    return dataclasses.replace(PRESETS["davis346"], noise=NoiseParameters(rms=noise_rms), leak_hz=0.1)


@dataclass(frozen=True)
class NoiseLoad:
    """Noise of about `events_hz` events a pixel and second; the time of its own, or with that of reading them out."""

    events_hz: float
    with_readout: bool = False

    def __call__(self) -> float:
        """Return microseconds that a step takes longer."""
        step = _whole(self.events_hz) if self.with_readout else _alone(self.events_hz)
        means = [statistics.fmean(step() for _ in range(_STEPS)) for _ in range(_BLOCKS + 1)]
        return statistics.median(means[1:]) * 1e6


def _still(p: SensorParameters) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    return np.full((p.height, p.width), _LIGHT, np.float32)


def _alone(events_hz: float) -> Callable[[], float]:
    """Return what takes a step of pixels and noise and returns the seconds of the latter."""
    p = noisy_sensor(events_hz)
    drawn, light = draw(p, _SEED), _still(p)
    pixels, noise = PixelArray(p, _SEED), NoiseEvents(p, _SEED, (drawn.on + drawn.off) / 2)
    pixels.reset(light, 0)

    def step() -> float:
        t_ns = pixels.state.t_ns + _STEP_NS
        crossings = pixels.step(light, t_ns)
        begun = time.perf_counter()
        noise.add_to(crossings, light.reshape(-1), t_ns)
        return time.perf_counter() - begun

    return step


@dataclass(frozen=True)
class NoiseShare:
    """How many times as long a step of a whole sensor takes with noise of `events_hz` events a pixel and second.

    The light of all pixels changes in each step, so that no pixel is skipped, and nothing fires but noise and leak.
    """

    events_hz: float

    def __call__(self) -> float:
        """Return the ratio of the medians of 25 means of 64 steps, taken in turns."""
        step = _both(self.events_hz, moving=True)
        pairs = [np.mean([step() for _ in range(_STEPS)], axis=0) for _ in range(_BLOCKS + 1)]
        noisy_s, quiet_s = np.median(pairs[1:], axis=0)
        return float(noisy_s / quiet_s)


def _whole(events_hz: float) -> Callable[[], float]:
    """Return what takes a step of two sensors and returns by how many seconds the noisy one is slower."""
    step = _both(events_hz)

    def difference() -> float:
        noisy_s, quiet_s = step()
        return noisy_s - quiet_s

    return difference


def _both(events_hz: float, *, moving: bool = False) -> Callable[[], tuple[float, float]]:
    """Return what takes a step of a noisy sensor and of a quiet one, and returns the seconds of each."""
    p = noisy_sensor(events_hz)
    light, t_ns = _still(p), 0
    noisy, quiet = Sensor(p, _SEED), Sensor(_with_rms(0.0), _SEED)
    for sensor in (noisy, quiet):
        sensor.reset(light, 0)

    def step() -> tuple[float, float]:
        nonlocal t_ns
        t_ns += _STEP_NS
        if moving:
            light.fill(_LIGHT * (1 + 1e-4 * (t_ns // _STEP_NS % 2)))
        begun = time.perf_counter()
        noisy.expose(light, t_ns)
        middle = time.perf_counter()
        quiet.expose(light, t_ns)
        return middle - begun, time.perf_counter() - middle

    return step
