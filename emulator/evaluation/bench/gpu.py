"""What a graphics card could take off the processor: pixel steps, pictures, and their way to memory, in ms.

All are done by whatever GL draws with here (`evstim doctor` tells), so on a machine without a graphics card they say
what the same work costs as a shader on the processor. `_on_cpu` is the processor's own kernel, for comparison.

    pixels     a step of the DAVIS346's pixels at that size, light and its derivative uploaded, sorted events back.
               quiet: still light; 20pct: an oblique sine grating at which 20 % of the pixels fire in a step
    picture    the rig itokawa's light at one time, in memory; pair: its light and derivative, two pictures
    readback   an empty picture, drawn and brought to memory by that way

Each figure is the median of steps over about a second, after a warm-up.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from emulator.evaluation.bench.pixels import grating
from emulator.gl.render_target import Stage, Strategy
from emulator.rig.loading import Rig, load_rig
from emulator.run.assembly import build_scene
from emulator.sensor.gpu.array import GpuArray
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import PRESETS

__all__ = ["Drawing", "PixelSteps", "Reading"]

_SECONDS = 1.0
_LEAST = 9
_WARM_UP = 3
_STEP_NS = 1_000_000
_TURN = 64  # pictures of a grating's turn; with a threshold of 0.27 and amplitude 1 this makes 20 % fire


def _median_ms(once: Callable[[], object]) -> float:
    """Return the median time of a call."""
    for _ in range(_WARM_UP):
        once()
    taken: list[float] = []
    while len(taken) < _LEAST or sum(taken) < _SECONDS:
        begun = time.perf_counter()
        once()
        taken.append(time.perf_counter() - begun)
    return statistics.median(taken) * 1e3


@dataclass(frozen=True)
class PixelSteps:
    """Steps of pixels of a sensor of `size` = (width, height), of which some fire or none."""

    size: tuple[int, int]
    fires: bool
    on_card: bool = True

    def __call__(self) -> float:
        """Return ms a step."""
        return self.run()[0]

    def run(self) -> tuple[float, float]:
        """Return ms a step, and the mean share of pixels that fired."""
        width, height = self.size
        sensor = dataclasses.replace(
            PRESETS["davis346"],
            width=width,
            height=height,
            leak_hz=0.0,
            parasitic_hz_at_reference=0.0,
            source_follower_hz=0.0,
        )
        turn = 2 * np.pi / _TURN if self.fires else 0.0
        pictures = [grating(sensor, -turn * k, turn) for k in range(_TURN if self.fires else 1)]
        array = (GpuArray if self.on_card else PixelArray)(sensor, 1)
        array.reset(pictures[0][0], 0, pictures[0][1])
        k = events = 0

        def step() -> None:
            nonlocal k, events
            k += 1
            light, rate = pictures[k % len(pictures)]
            events += len(array.step(light, k * _STEP_NS, rate))

        ms = _median_ms(step)
        return ms, events / k / (width * height)


@dataclass(frozen=True)
class Drawing:
    """Pictures of the rig itokawa at `size` = (width, height), with their derivatives or without."""

    size: tuple[int, int]
    with_rate: bool

    def __call__(self) -> float:
        """Return ms a picture, or pair."""
        light, rate = (np.zeros(self.size[::-1], np.float32) for _ in range(2))
        t_ns = 0
        with build_scene(_by_gl(load_rig("itokawa")), self.size) as scene:

            def draw() -> None:
                nonlocal t_ns
                t_ns += _STEP_NS
                if self.with_rate:
                    scene.light_and_rate(t_ns, light, rate)
                else:
                    scene.light(t_ns, light)

            return _median_ms(draw)


def _by_gl(rig: Rig) -> Rig:
    return dataclasses.replace(rig, run=dataclasses.replace(rig.run, painter="gl"))


@dataclass(frozen=True)
class Reading:
    """Empty pictures of `size` = (width, height), brought to memory by one way."""

    size: tuple[int, int]
    readback: Strategy

    def __call__(self) -> float:
        """Return ms a picture."""
        stage, out = Stage(self.size, 1, readback=self.readback), np.zeros(self.size[::-1], np.float32)
        ms = _median_ms(lambda: stage.draw(lambda _: None, out))
        stage.close()
        return ms
