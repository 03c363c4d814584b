"""The parts of a sensor: its pixels, delays, read-out, and other sources of events."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from emulator.sensor.chip.defects import Defects
from emulator.sensor.chip.readout import ArbiterReadOut, Jitter, ReadOut
from emulator.sensor.chip.scan import ScanReadOut
from emulator.sensor.chip.sources import BackgroundEvents, Particles
from emulator.sensor.methods.base import PixelMethod
from emulator.sensor.methods.large_signal import LargeSignalPixels
from emulator.sensor.noise.grid import NoisyPixels
from emulator.sensor.noise.points import NoiseEvents
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.crossings import NO_CROSSINGS, Crossings, joined
from emulator.sensor.pixels.state import draw
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Events

__all__ = [
    "Source",
    "dead_pixels",
    "finished",
    "make_jitter",
    "make_noise",
    "make_readout",
    "make_sources",
    "own_pixels",
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


def own_pixels(p: SensorParameters, seed: int, threads: int = 0) -> PixelMethod:
    """Return evstim's own pixels with the effects of the sensor; `threads` as in `PixelArray`."""
    if p.photoreceptor == "large_signal":
        return LargeSignalPixels(p, seed)
    on_grid = bool(p.noise.rms) and p.noise.grade == "grid"
    return NoisyPixels(p, seed) if on_grid else PixelArray(p, seed, threads)


def make_jitter(p: SensorParameters, seed: int) -> Jitter | None:
    """Return the delays of a sensor's events; None where there are none."""
    return Jitter(p.jitter, seed, p.width * p.height) if p.jitter.latency_us else None


def make_readout(p: SensorParameters) -> ReadOut:
    """Return the sensor's read-out, at rest."""
    return ScanReadOut(p) if p.readout.scan_us else ArbiterReadOut(p)


def finished(jitter: Jitter | None, readout: ReadOut, late: Crossings = NO_CROSSINGS) -> Events:
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


def make_sources(p: SensorParameters, seed: int, defects: Defects, noise: NoiseEvents | None) -> list[Source]:
    """Return the sources of events beside the pixels, `noise` among them; dead pixels have none."""
    sources: list[Source] = [] if noise is None else [noise]
    if p.background.hz or p.background.hot_share * p.background.hot_hz:
        sources.append(BackgroundEvents(p, seed, defects.dead))
    if p.radiation.hits_per_cm2_s:
        sources.append(Particles(p, seed, defects.dead))
    return sources
