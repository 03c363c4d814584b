"""The parts of a sensor beside its pixels: what delays, what reads out, and other sources of events.

Figures of an array's pixels that can change between two steps, as the biases of a chip can.

What the comparator sees does not jump: a new threshold is compared with the same stored level, and the reference moves
with the leak (see `faults`). A pixel that is in its refractory period stays there until the end that it had.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from emulator.sensor.chip.defects import Defects
from emulator.sensor.chip.readout import Jitter, ReadOut
from emulator.sensor.chip.scan import ScanReadOut
from emulator.sensor.chip.sources import BackgroundEvents, Particles
from emulator.sensor.noise.points import NoiseEvents
from emulator.sensor.pixels.array import Crossings, PixelArray
from emulator.sensor.pixels.merging import NO_CROSSINGS, joined
from emulator.sensor.pixels.state import DEAD_THRESHOLD, Field, draw, light_constants
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Events

__all__ = [
    "ADJUSTABLE",
    "Source",
    "adjust",
    "dead_pixels",
    "finished",
    "live_thresholds",
    "make_jitter",
    "make_noise",
    "make_readout",
    "make_sources",
]


_Float32s = npt.NDArray[np.float32]


class Source(Protocol):
    """A source of events beside the pixels: noise, particles."""

    def reset(self, t_ns: int) -> None:
        """Start at `t_ns`."""

    def add_to(self, crossings: Crossings, light: _Float32s, t_ns: int) -> Crossings:
        """Return a step's crossings with the source's events up to `t_ns`; `light`, (pixels,), is the step's last."""
        ...

    def step(self, light: _Float32s, t_ns: int) -> Crossings:
        """Return the source's events up to `t_ns` alone."""
        ...


def make_jitter(p: SensorParameters, seed: int) -> Jitter | None:
    """Return the delays of a sensor's events; None where there are none."""
    return Jitter(p.jitter, seed, p.width * p.height) if p.jitter.latency_us else None


def make_readout(p: SensorParameters) -> ReadOut | ScanReadOut:
    """Return the sensor's read-out, at rest."""
    return ScanReadOut(p) if p.readout.scan_us else ReadOut(p)


def finished(jitter: Jitter | None, readout: ReadOut | ScanReadOut, late: Crossings = NO_CROSSINGS) -> Events:
    """Return the events that a read-out, and a delay before it, have not sent yet.

    `late` are crossings after the last step. They are delayed as all are, so they may leave before earlier ones.
    """
    if jitter is not None:
        begun = jitter.step(late, int(late.t_ns[-1]) + 1) if len(late) else late
        late = joined([begun, jitter.step(NO_CROSSINGS, jitter.last_ns() + 1)])
    sent = [readout.push(late, int(late.t_ns[-1]) + 1)] if len(late) else []
    return np.concatenate([*sent, readout.finish()])


def dead_pixels(p: SensorParameters, defects: Defects) -> npt.NDArray[np.bool_] | None:
    """Return which pixels are dead, (pixels,); None if none is."""
    if not defects.dead.size:
        return None
    dead = np.zeros(p.width * p.height, np.bool_)
    dead[defects.dead] = True
    return dead


def make_noise(p: SensorParameters, seed: int, defects: Defects) -> NoiseEvents | None:
    """Return the noise of the grade "points"; None where there is none. Dead pixels have none."""
    if not p.noise.rms or p.noise.grade != "points" or defects.dead.size == p.width * p.height:
        return None
    drawn = draw(p, seed)
    thresholds = (drawn.on + drawn.off) / 2
    thresholds[defects.dead] = np.inf
    return NoiseEvents(p, seed, thresholds)


def live_thresholds(pixels: PixelArray) -> npt.NDArray[np.float64]:
    """Return the mean of each pixel's two thresholds, (pixels,), as they are now; infinite for dead pixels."""
    on, off = (pixels.field(which).reshape(-1).astype(np.float64) for which in (Field.ON, Field.OFF))
    return np.where(on < DEAD_THRESHOLD, (on + off) / 2, np.inf)


def make_sources(p: SensorParameters, seed: int, defects: Defects, noise: NoiseEvents | None) -> list[Source]:
    """Return the sources of events beside the pixels, `noise` among them; dead pixels have none."""
    sources: list[Source] = [] if noise is None else [noise]
    if p.background.hz or p.background.hot_share * p.background.hot_hz:
        sources.append(BackgroundEvents(p, seed, defects.dead))
    if p.radiation.hits_per_cm2_s:
        sources.append(Particles(p, seed, defects.dead))
    return sources


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
