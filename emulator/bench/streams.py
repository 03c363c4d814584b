"""Reproducible streams of events for measurements."""

from __future__ import annotations

import numpy as np

from emulator.rig.loading import load_rig
from emulator.scene.checkerboard.checkerboard import Checkerboard
from emulator.scene.checkerboard.table import CheckerboardParameters
from emulator.sensor.chip.readout import ReadOut
from emulator.sensor.pixels.array import PixelArray
from firmware_protocol.events import Events, empty_events

__all__ = ["checkerboard_stream", "saturated_stream"]


def saturated_stream(count: int, event_ns: int = 80, row_events: int = 8) -> Events:
    """Return what a saturated read-out sends: an event every `event_ns`, `row_events` of them from each row it serves.

    With the defaults 12.5 Mev/s. Rows follow each other as a round-robin arbiter takes them; columns are random.
    """
    rng = np.random.default_rng(346)
    index = np.arange(count)
    events = empty_events(count)
    events["t"] = index * event_ns // 1000
    events["x"] = rng.integers(0, 346, count)
    events["y"] = index // row_events * 3 % 260
    events["on"] = rng.integers(0, 2, count)
    return events


def checkerboard_stream(count: int) -> Events:
    """Return the first `count` events of the shipped checkerboard rig, as its read-out sends them."""
    rig = load_rig("checkerboard")
    if not isinstance(rig.scene, CheckerboardParameters):
        raise TypeError("the shipped checkerboard rig shows no checkerboard")
    sensor = rig.camera.sensor
    scene = Checkerboard(rig.scene, (sensor.width, sensor.height))
    pixels, readout = PixelArray(sensor, rig.run.seed), ReadOut(sensor)
    light = np.zeros((sensor.height, sensor.width), np.float32)
    scene.light(0, light)
    pixels.reset(light, 0)
    batches, filled, t_ns = [], 0, 0
    while filled < count:
        t_ns += rig.run.step_us * 1000
        scene.light(t_ns, light)
        batches.append(readout.push(pixels.step(light, t_ns), t_ns).copy())
        filled += len(batches[-1])
    return np.concatenate(batches)[:count]
