"""Frames a second of a scene with its sensor, free running: light, pixels and read-out, events and all.

The rigs are the shipped ones, without their links; at 1280x720 the sensor is the imx636 preset's size with the same
pixels. Each figure is the median of runs of about a second, after a warm-up that compiles and settles.
"""

from __future__ import annotations

import dataclasses
import statistics
import time

import numpy as np

from emulator.assembly import build_scene
from emulator.rig import Rig, load_rig
from emulator.sensor.pixels import PixelArray
from emulator.sensor.readout import ReadOut

__all__ = ["checkerboard_346x260", "checkerboard_1280x720", "eros_346x260", "eros_1280x720", "frames_per_second"]

_REPEATS = 5
_REPEAT_S = 1.0


def checkerboard_346x260() -> float:
    """Frames/s of the shipped checkerboard rig."""
    return frames_per_second(load_rig("checkerboard"), (346, 260))


def checkerboard_1280x720() -> float:
    """Frames/s of the shipped checkerboard rig, at 1280x720."""
    return frames_per_second(load_rig("checkerboard"), (1280, 720))


def eros_346x260() -> float:
    """Frames/s of the shipped Eros rig, 2x2 samples."""
    return frames_per_second(load_rig("eros"), (346, 260))


def eros_1280x720() -> float:
    """Frames/s of the shipped Eros rig at 1280x720, 2x2 samples."""
    return frames_per_second(load_rig("eros"), (1280, 720))


def frames_per_second(rig: Rig, size: tuple[int, int]) -> float:
    """Run scene, pixels and read-out of `rig` at `size` = (width, height); returns the median frames/s."""
    sensor = dataclasses.replace(rig.camera.sensor, width=size[0], height=size[1])
    light = np.zeros((size[1], size[0]), np.float32)
    pixels, readout = PixelArray(sensor, rig.run.seed), ReadOut(sensor)
    step_ns = rig.run.step_us * 1000
    rates: list[float] = []
    with build_scene(rig.scene, size) as scene:
        scene.light(0, light)
        pixels.reset(light, 0)
        t_ns = 0
        for repeat in range(_REPEATS + 1):
            frames, start_s = 0, time.perf_counter()
            while time.perf_counter() - start_s < _REPEAT_S:
                t_ns += step_ns
                scene.light(t_ns, light)
                readout.push(pixels.step(light, t_ns), t_ns)
                frames += 1
            if repeat:  # the first one compiles and settles
                rates.append(frames / (time.perf_counter() - start_s))
    return statistics.median(rates)
