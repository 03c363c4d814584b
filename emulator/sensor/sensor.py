"""The whole sensor: light in, events out.

    light -> imager -> pixels -> jitter --+--> read-out -> events
                         ^      noise ----+
                       leaks    radiation +

Every part that a rig leaves off is not there and costs nothing. Some parts change at fixed stream times (the grid of
shot noise, leak that varies, pixels turning hot): a step that goes across such a time is cut there, with the light part
of the way on a straight line in the logarithm of the photocurrent, as `PixelArray` takes it anyway. So what comes out
depends on the pictures and the seed, and on nothing else.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol

import numpy as np
import numpy.typing as npt

from emulator.light import PixelLight
from emulator.sensor.chip.defects import ArrayFaults, Defects, Faults, draw_defects
from emulator.sensor.chip.imager import Imager, part_of_the_way
from emulator.sensor.chip.jitter import Jitter
from emulator.sensor.chip.leak import NEVER_NS, Leaks
from emulator.sensor.chip.radiation import Particles
from emulator.sensor.chip.readout import ReadOut
from emulator.sensor.chip.temperature import at_temperature
from emulator.sensor.effects import DefectParameters
from emulator.sensor.gpu.array import GpuArray
from emulator.sensor.noise.grid import NoisyPixels
from emulator.sensor.noise.point_process import NoiseEvents
from emulator.sensor.pixels.array import Crossings, PixelArray
from emulator.sensor.pixels.merging import NO_CROSSINGS, joined
from emulator.sensor.pixels.mismatch import draw
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Events

__all__ = ["MakePixels", "PixelMethod", "Sensor"]

_Float32s = npt.NDArray[np.float32]


class PixelMethod(Protocol):
    """What turns light into crossings: `PixelArray`, or another's rule."""

    lost_in_pixel: int
    quiet_nan: int

    def reset(self, light: _Float32s, t_ns: int) -> None:
        """Start at `t_ns` at rest on `light`, (height, width) float32."""

    def step(self, light: _Float32s, t_ns: int, rate: _Float32s | None = None) -> Crossings:
        """Move to `t_ns`, where the light is `light`, its time derivative `rate`; return the crossings on the way."""


class _Source(Protocol):
    """What raises events of its own: noise, particles."""

    def reset(self, t_ns: int) -> None:
        """Start at `t_ns`."""

    def add_to(self, crossings: Crossings, light: _Float32s, t_ns: int) -> Crossings:
        """Return a step's crossings with the source's events up to `t_ns`; `light`, (pixels,), is the step's last."""


MakePixels = Callable[[SensorParameters, int], PixelMethod]
"""Makes the pixels of a sensor from its parameters and a seed."""


class Sensor:
    """A sensor from light to events.

    Parameters
    ----------
    parameters : the sensor and its effects.
    seed : keys all that is random.
    make_pixels : the pixels' method.

    Attributes
    ----------
    parameters : as given.
    pixels : the pixels.

    Raises
    ------
    ValueError
        An effect that only `PixelArray` has (defects, changing leak) is asked of another method.
    """

    def __init__(self, parameters: SensorParameters, seed: int, make_pixels: MakePixels = PixelArray) -> None:
        self.parameters = parameters
        here = at_temperature(parameters)
        self._imager = Imager(here, seed)
        own = dataclasses.replace(here, dark_current_relative=self._imager.dark_current_relative)
        self.pixels = _pixels(own, seed, make_pixels)
        defects = draw_defects(own, seed)
        self._dead = _dead(own, defects)
        self._leaks = _leaks(self.pixels, own, seed, defects)
        self._sources = _sources(own, seed, defects)
        self._jitter = Jitter(own.jitter, seed, own.width * own.height) if own.jitter.latency_us else None
        self._readout = ReadOut(own)
        self._dark = np.float32(here.dark_current_relative)
        self._before, self._way = (np.empty((own.height, own.width), np.float32) for _ in range(2))
        self._t_ns = 0

    @property
    def raised(self) -> int:
        """Events that came to be: lost_in_pixel + lost_at_readout + read_out + pending."""
        return self._readout.raised + self.pixels.lost_in_pixel + self._delayed

    @property
    def lost_in_pixel(self) -> int:
        """Crossings beyond what a pixel can have in a step."""
        return self.pixels.lost_in_pixel

    @property
    def lost_at_readout(self) -> int:
        """Crossings of pixels whose request still waited."""
        return self._readout.lost_at_readout

    @property
    def read_out(self) -> int:
        """Events returned."""
        return self._readout.read_out

    @property
    def pending(self) -> int:
        """Events that are raised and not yet returned."""
        return self._readout.pending + self._delayed

    @property
    def _delayed(self) -> int:
        return self._jitter.waiting if self._jitter is not None else 0

    @property
    def suspect_share(self) -> float | None:
        """Share of the solved pixel-steps whose light did something unseen between pictures; None where not known.

        The honest measure of whether pictures are close enough together.
        """
        if not isinstance(self.pixels, PixelArray | GpuArray):
            return None
        return self.pixels.suspects / max(self.pixels.candidates, 1)

    @property
    def renderer(self) -> str | None:
        """The name of what computes the pixels, in GL's words; None for the processor."""
        return self.pixels.renderer if isinstance(self.pixels, GpuArray) else None

    @property
    def quiet_nan(self) -> int:
        """Pixel-steps whose light was NaN or infinite."""
        return self.pixels.quiet_nan

    def warm_up(self) -> None:
        """Compile the kernels, or load them from disk, by flashing a light at a few pixels like these."""
        few = dataclasses.replace(self.parameters, width=16, height=16, defects=DefectParameters())
        flashed = Sensor(few, 0)
        flashed.reset(np.zeros((16, 16), np.float32), 0)
        flashed.expose(np.ones((16, 16), np.float32), 1_000_000, np.zeros((16, 16), np.float32))
        flashed.finish()

    def reset(self, light: _Float32s, t_ns: int) -> None:
        """Start anew at `t_ns`, at rest on `light`, (height, width) float32: nothing pending, nothing counted."""
        self._readout = ReadOut(self.parameters)
        self._t_ns = int(t_ns)
        if self._leaks is not None:
            self._leaks.follow(self._t_ns)
        self.pixels.reset(self._imager.see(light, self._t_ns), self._t_ns)
        for source in self._sources:
            source.reset(self._t_ns)
        if self._jitter is not None:
            self._jitter.reset(self._t_ns)
        self._remember(light)

    def expose(
        self, light: _Float32s, t_ns: int, rate: _Float32s | None = None, at: PixelLight | None = None
    ) -> Events:
        """Move to `t_ns` and return the events that leave before it.

        Parameters
        ----------
        light : (height, width) float32, relative to the reference level, at `t_ns`; below 0 counts as 0.
        t_ns : stream time, not before the last one.
        rate : (height, width) float32, the light's time derivative at `t_ns`, per second; None: not known.
        at : tells the light of single pixels in between; None: not to be had.

        Returns
        -------
        (n,) EVENT, sorted by t.

        Raises
        ------
        ValueError
            Time goes back, or the picture has not the sensor's size.
        """
        t_ns, parts = int(t_ns), []
        t0_ns = self._t_ns
        while (cut_ns := self._next_cut_ns()) < t_ns:
            share = (cut_ns - t0_ns) / (t_ns - t0_ns)
            parts.append(_kept(self._move(self._between(light, share), cut_ns, None)))
        parts.append(self._move(light, t_ns, rate, at))
        self._remember(light)
        return self._readout.push(joined(parts), self._settled_ns())

    def finish(self) -> Events:
        """Return the events that have not left yet; nothing can be exposed afterwards."""
        if self._jitter is None:
            return self._readout.finish()
        end_ns = self._jitter.last_ns() + 1
        late = self._readout.push(self._jitter.step(NO_CROSSINGS, end_ns), end_ns)
        return np.concatenate([late, self._readout.finish()])

    def _next_cut_ns(self) -> int:
        """Return the next time after now that must be the end of a step."""
        grid_ns = self._imager.grid_ns
        shot_ns = (self._t_ns // grid_ns + 1) * grid_ns if grid_ns else NEVER_NS
        return min(shot_ns, self._leaks.next_ns) if self._leaks is not None else shot_ns

    def _move(self, light: _Float32s, t_ns: int, rate: _Float32s | None, at: PixelLight | None = None) -> Crossings:
        """Take all parts to `t_ns`, over no cut."""
        if self._leaks is not None and self._leaks.next_ns <= self._t_ns:
            self._leaks.follow(self._t_ns)
        seen = self._imager.see(light, t_ns)
        crossings = self._of_live_pixels(self._cross(seen, t_ns, self._imager.see_rate(rate), at))
        self._t_ns = t_ns
        settled_ns = self._settled_ns()
        if self._jitter is not None:
            crossings = self._jitter.step(crossings, settled_ns)
        for source in self._sources:
            crossings = source.add_to(crossings, seen.reshape(-1), settled_ns)
        return crossings

    def _cross(self, seen: _Float32s, t_ns: int, rate: _Float32s | None, at: PixelLight | None) -> Crossings:
        """Move the pixels; evstim's own can make use of light in between."""
        if isinstance(self.pixels, PixelArray):
            return self.pixels.step(seen, t_ns, rate, self._imager.see_pixels(at))
        return self.pixels.step(seen, t_ns, rate)

    def _settled_ns(self) -> int:
        """Return the time up to which all crossings are known."""
        return self.pixels.settled_ns if isinstance(self.pixels, NoisyPixels) else self._t_ns

    def _of_live_pixels(self, crossings: Crossings) -> Crossings:
        """Return the crossings without those of dead pixels."""
        if self._dead is None:
            return crossings
        live = ~self._dead[crossings.pixel]
        return dataclasses.replace(
            crossings, t_ns=crossings.t_ns[live], pixel=crossings.pixel[live], on=crossings.on[live]
        )

    def _between(self, light: _Float32s, share: float) -> _Float32s:
        """Return the light part of the way from the last picture, straight in the log of the photocurrent."""
        before, after, out = self._before.reshape(-1), np.ascontiguousarray(light).reshape(-1), self._way.reshape(-1)
        part_of_the_way(before, after, self._dark, np.float32(share), out)
        return self._way

    def _remember(self, light: _Float32s) -> None:
        """Keep the last picture, if a step may have to be cut."""
        if self._next_cut_ns() < NEVER_NS:
            self._before[:] = light


def _kept(crossings: Crossings) -> Crossings:
    """Return a copy that outlives the next step."""
    return dataclasses.replace(
        crossings, t_ns=crossings.t_ns.copy(), pixel=crossings.pixel.copy(), on=crossings.on.copy()
    )


def _pixels(p: SensorParameters, seed: int, make_pixels: MakePixels) -> PixelMethod:
    """Return the pixels, which have their noise in them where it is of the grid grade."""
    if p.noise.rms == 0 or p.noise.grade != "grid":
        return make_pixels(p, seed)
    if make_pixels is not PixelArray:
        raise ValueError('noise.grade = "grid" is a method of its own: leave it out, or the other method')
    return NoisyPixels(p, seed)


def _leaks(pixels: PixelMethod, p: SensorParameters, seed: int, defects: Defects) -> Leaks | None:
    """Give the pixels their defects; return what changes their leak while they run, if anything does."""
    if not (defects.hot.size or defects.dead.size or p.jitter.leak_share):
        return None
    if not isinstance(pixels, PixelArray | NoisyPixels):
        raise ValueError("defects, dose and jitter.leak_share need evstim's own pixels: leave them out, or the method")
    faults: Faults = ArrayFaults(pixels) if isinstance(pixels, PixelArray) else pixels
    faults.kill(defects.dead)
    return Leaks(faults, seed, p.jitter.leak_share, defects)


def _dead(p: SensorParameters, defects: Defects) -> npt.NDArray[np.bool_] | None:
    """Return whether each pixel is dead; None if none is."""
    if not defects.dead.size:
        return None
    dead = np.zeros(p.width * p.height, np.bool_)
    dead[defects.dead] = True
    return dead


def _sources(p: SensorParameters, seed: int, defects: Defects) -> list[_Source]:
    """Return what raises events of its own; dead pixels do not."""
    sources: list[_Source] = []
    if p.noise.rms and p.noise.grade == "points" and defects.dead.size < p.width * p.height:
        drawn = draw(p, seed)
        thresholds = (drawn.on + drawn.off) / 2
        thresholds[defects.dead] = np.inf
        sources.append(NoiseEvents(p, seed, thresholds))
    if p.radiation.hits_per_cm2_s:
        sources.append(Particles(p, seed, defects.dead))
    return sources
