"""Frames per second of a scene with its sensor, free running: light, pixels and read-out.

The rigs are the shipped ones, without their links; at 1280x720 the sensor is the imx636 preset's size with the same
pixels. Without slopes a step takes one frame, and interpolates log light linearly from the last one; with slopes
(`_hermite`, the default of a rig) it takes the light's derivative too, which for a mesh is a second frame, and needs
several times fewer steps for the same accuracy. Each result is the median of runs of about a second, after a warm-up
that compiles and settles.

`Drawing` times a light frame drawn by GL: GL selects the renderer, often a software one.
`evstim doctor --all` lists them.

`ScenesAlike` compares steps in scenes with about the same number of events, in different pixels, on 346 x 260 pixels;
each frame has its time derivative, as in a run, which for a jump between two frames is zero. The result is the time of
a step in the slowest of them over that in the first, which is the usual case. Scenes take their steps in turns, so that
a busy machine slows all alike.

    grating     every pixel's light changes, some reach a threshold; all other scenes are at rest but for a few pixels
    flashing    as few pixels as possible: flashes of 13 e-folds and back (low-pass wide open), 46 events a step
    block       neighbours that jump by 2.15 thresholds and back: an event each
    scattered   pixels far apart that do the same
    rows        pixels of whole rows, which the read-out latches together
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from emulator.light import LightFrame, SceneFrames
from emulator.rig.loading import Rig, load_rig
from emulator.run.assembly import build_scene
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import PRESETS, SensorParameters
from emulator.sensor.sensor import Sensor
from firmware_protocol.events import Float32s, Int64s

_REPEATS = 5
_REPEAT_S = 1.0


@dataclass(frozen=True)
class Workload:
    """A shipped rig at `size` = (width, height) pixels, with the light's derivative or without."""

    rig: str
    size: tuple[int, int]
    with_rate: bool = False

    def __call__(self) -> float:
        """Return steps a second."""
        return steps_per_second(load_rig(self.rig), self.size, with_rate=self.with_rate)


def steps_per_second(rig: Rig, size: tuple[int, int], *, with_rate: bool) -> float:
    """Run scene and sensor of `rig` at `size` = (width, height); returns the median of steps a second."""
    sensor = Sensor(dataclasses.replace(rig.camera.sensor, width=size[0], height=size[1]), rig.run.seed)
    step_ns = rig.run.step_us * 1000
    rates: list[float] = []
    with build_scene(rig, size) as scene:
        frames = SceneFrames(scene, with_rate=with_rate)
        sensor.reset(frames.draw(0))
        t_ns = 0
        for repeat in range(_REPEATS + 1):
            steps, start_s = 0, time.perf_counter()
            while time.perf_counter() - start_s < _REPEAT_S:
                t_ns += step_ns
                sensor.expose(frames.draw(t_ns))
                steps += 1
            if repeat:  # the first one compiles and settles
                rates.append(steps / (time.perf_counter() - start_s))
    return statistics.median(rates)


_LEAST_FRAMES, _FIRST_FRAMES = 9, 3


@dataclass(frozen=True)
class Drawing:
    """Light frames of the rig itokawa at `size` = (width, height), drawn by GL, lens included."""

    size: tuple[int, int]

    def __call__(self) -> float:
        """Return the median of ms a frame, over about a second."""
        rig = load_rig("itokawa")
        light, seconds = np.zeros(self.size[::-1], np.float32), list[float]()
        with build_scene(dataclasses.replace(rig, run=dataclasses.replace(rig.run, painter="gl")), self.size) as scene:
            for k in range(_FIRST_FRAMES):
                scene.light(k * _STEP_NS, light)
            while len(seconds) < _LEAST_FRAMES or sum(seconds) < _REPEAT_S:
                start_s = time.perf_counter()
                scene.light((_FIRST_FRAMES + len(seconds)) * _STEP_NS, light)
                seconds.append(time.perf_counter() - start_s)
        return statistics.median(seconds) * 1e3


_STEP_NS = 1_000_000
_STEPS, _WARM_UP, _SETTLED = 120, 20, 10
_PERIOD_PX = 40
_FLASH, _FLASH_EVENTS = 13.0, 46

_Frame = tuple[Float32s, Float32s]
"""Light and its time derivative, a second."""

_SENSOR = dataclasses.replace(
    PRESETS["davis346"], refractory_us=0.0, leak_hz=0.01, parasitic_hz_at_reference=0.0, source_follower_hz=0.0,
    noise=NoiseParameters(),
)  # fmt: skip
_FAST = dataclasses.replace(_SENSOR, corner_hz_at_reference=1e6, corner_min_hz=1e6, corner_max_hz=1e6)
_THRESHOLD = (_SENSOR.threshold_on + _SENSOR.threshold_off) / 2
_PIXELS = _SENSOR.width * _SENSOR.height


def _grating(events: int, k: int) -> _Frame:
    """Return a drifting sine of amplitude 1, which changes by a threshold at each turn without events, then fires.

    Before step 0 it completes one period, in 20 steps, so that all pixels have had their turns.
    """
    y, x = np.mgrid[: _SENSOR.height, : _SENSOR.width]
    turn = events / _PIXELS * _THRESHOLD * np.pi / (2 - _THRESHOLD) if k >= 0 else 2 * np.pi / _WARM_UP
    angle = 2 * np.pi * (x + 0.5 * y) / _PERIOD_PX - turn * k
    light = 0.5 * np.exp(np.sin(angle))
    return light.astype(np.float32), (-light * np.cos(angle) * turn * 1e9 / _STEP_NS).astype(np.float32)


def _jumping(pixels: Int64s, by: float, k: int) -> _Frame:
    light = np.full((_SENSOR.height, _SENSOR.width), 0.3, np.float32)
    light.reshape(-1)[pixels] *= np.float32(math.exp(by if k % 2 else 0.0))
    return light, np.zeros_like(light)


def _places(events: int) -> dict[str, Int64s]:
    """Return the pixels that jump, for all scenes in which they jump alike."""
    side = math.isqrt(events)
    block = (80 + np.arange(side))[:, None] * _SENSOR.width + 80 + np.arange(side)
    return {
        "block": block.reshape(-1),
        "scattered": np.arange(events) * (_PIXELS // events),
        "rows": 100 * _SENSOR.width + np.arange(events),
    }


def _scenes(events: int) -> dict[str, tuple[SensorParameters, Callable[[int], _Frame]]]:
    """Return sensor and light frame at step k of each scene, the usual one first."""
    flashing = (np.arange(max(1, round(events / _FLASH_EVENTS))) * 997 + 40_000) % _PIXELS
    jumping = {
        name: (_SENSOR, lambda k, pixels=pixels: _jumping(pixels, 2.15 * _THRESHOLD, k))
        for name, pixels in _places(events).items()
    }
    return {
        "grating": (_SENSOR, lambda k: _grating(events, k)),
        "flashing": (_FAST, lambda k: _jumping(flashing, _FLASH, k)),
        **jumping,
    }


@dataclass(frozen=True)
class ScenesAlike:
    """Scenes of about `events` events a step."""

    events: int

    def __call__(self) -> float:
        """Return the time of a step of the slowest scene over that of the usual one."""
        times = [seconds for seconds, _ in self.times().values()]
        return max(times) / times[0]

    def times(self) -> dict[str, tuple[float, float]]:
        """Return the median seconds of a step of each scene, and its mean number of events; the usual one first."""
        scenes = _scenes(self.events)
        arrays = {name: PixelArray(sensor, 1) for name, (sensor, _) in scenes.items()}
        seconds: dict[str, list[float]] = {name: [] for name in scenes}
        found = dict.fromkeys(scenes, 0)
        for k in range(-_WARM_UP, _STEPS):
            for name, array in arrays.items():
                light, rate = scenes[name][1](k)
                if k == -_WARM_UP:
                    array.reset(LightFrame(0, light, rate))
                begun = time.perf_counter()
                crossings = array.step(LightFrame((k + _WARM_UP) * _STEP_NS, light, rate))
                if k >= _SETTLED:
                    seconds[name].append(time.perf_counter() - begun)
                    found[name] += len(crossings)
        return {name: (statistics.median(s), found[name] / len(s)) for name, s in seconds.items()}
