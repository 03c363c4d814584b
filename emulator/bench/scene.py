"""Frames per second of a scene with its sensor, free running: light, pixels and read-out.

The rigs are the shipped ones, without their links; at 1280x720 the sensor is the imx636 preset's size with the same
pixels. Without slopes a step takes one frame, and interpolates log light linearly from the last one; with slopes
(`_hermite`, the default of a rig) it takes the light's derivative too, which for a mesh is a second frame, and needs
several times fewer steps for the same accuracy. Each figure is the median of runs of about a second,
after a warm-up that compiles and settles.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from dataclasses import dataclass

from emulator.rig.loading import Rig, load_rig
from emulator.run.frames import Pictures
from emulator.run.scene_assembly import build_scene
from emulator.sensor.sensor import Sensor

__all__ = ["Workload", "steps_per_second"]

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
        picture = Pictures(scene, with_rate=with_rate)
        picture.draw(0)
        sensor.reset(picture.light, 0)
        t_ns = 0
        for repeat in range(_REPEATS + 1):
            steps, start_s = 0, time.perf_counter()
            while time.perf_counter() - start_s < _REPEAT_S:
                t_ns += step_ns
                picture.draw(t_ns)
                sensor.expose(picture.light, t_ns, picture.rate, None, picture.changed)
                steps += 1
            if repeat:  # the first one compiles and settles
                rates.append(steps / (time.perf_counter() - start_s))
    return statistics.median(rates)
