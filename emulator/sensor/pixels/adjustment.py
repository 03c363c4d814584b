"""Figures of an array's pixels that can change between two steps, as the biases of a chip can.

What the comparator sees does not jump: a new threshold is compared with the same stored level, and the reference moves
with the leak (see `faults`). A pixel that is in its refractory period stays there until the end that it had.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.faults import DEAD_THRESHOLD
from emulator.sensor.pixels.mismatch import draw
from emulator.sensor.pixels.state import Field, light_constants
from emulator.sensor.presets import SensorParameters

__all__ = ["ADJUSTABLE", "adjust"]

ADJUSTABLE = ("threshold_on", "threshold_off", "leak_hz", "refractory_us", "corner_max_hz", "source_follower_hz")
"""Fields of SensorParameters that `adjust` can change."""


def adjust(array: PixelArray, name: str, value: float) -> None:
    """Set one of `ADJUSTABLE` from the array's time on; raises ValueError where the value is not allowed."""
    before = array.parameters
    if name == "source_follower_hz" and not (before.source_follower_hz > 0 and value > 0):
        raise ValueError("source_follower_hz can change between figures above 0: its pole is there or it is not")
    changed: dict[str, Any] = {name: value}
    after = dataclasses.replace(before, **changed)
    if name == "threshold_on":
        _scale(array, Field.ON, after.threshold_on / before.threshold_on)
        _move_leak(array, after.threshold_on / before.threshold_on)  # events a second stay as they were
    elif name == "threshold_off":
        _scale(array, Field.OFF, after.threshold_off / before.threshold_off)
    elif name == "leak_hz":
        _set_leak(array, before, after)
    array.parameters = after
    array.follow_parameters(light_constants(after))


def _scale(array: PixelArray, which: Field, ratio: float) -> None:
    """Multiply a threshold of all pixels that are not dead."""
    values = array.state.fields[:, which]
    values *= np.where(values < DEAD_THRESHOLD, np.float32(ratio), np.float32(1))


def _set_leak(array: PixelArray, before: SensorParameters, after: SensorParameters) -> None:
    if before.leak_hz:
        _move_leak(array, after.leak_hz / before.leak_hz)
        return
    drawn = draw(after, array.seed)
    array.faults().set_leak(drawn.leak / drawn.on)


def _move_leak(array: PixelArray, ratio: float) -> None:
    """Multiply the leak of all pixels, and keep the level that each comparator sees."""
    state = array.state
    leak, since_epoch_s = state.fields[:, Field.LEAK], np.float32((state.t_ns - state.epoch_ns) * 1e-9)
    more = leak * np.float32(ratio) - leak
    state.fields[:, Field.REFERENCE] += more * since_epoch_s
    leak += more
