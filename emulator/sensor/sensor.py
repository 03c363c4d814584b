"""The whole sensor: light in, events out.

    light -> imager -> pixels -> jitter ------+--> read-out -> events
                         ^ ^        radiation +
                     leaks kicks   background +

A part that the rig leaves off does not exist and costs nothing. Some parts change at fixed stream times (the grid of
shot noise, changing leak, pixels turning hot). A step across such a time is cut there; the light at the cut lies on a
straight line in the logarithm of the photocurrent. So the events depend on the frames and the seed only.

An `EventSource` is the source of a session's events: a sensor, or a recording in its place.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from emulator.light import LightFrame, Region
from emulator.sensor.chip.defects import NEVER_NS, Defects, Leaks, at_temperature, draw_defects
from emulator.sensor.chip.imager import Imager, part_of_the_way
from emulator.sensor.chip.readout import ArbiterReadOut, Jitter, ReadOut
from emulator.sensor.chip.scan import ScanReadOut
from emulator.sensor.chip.sources import BackgroundEvents, Particles, SlottedEvents, hits_per_second
from emulator.sensor.noise.law import corner_hz, fixed_corner_hz, rms, still_hz
from emulator.sensor.parameters import DefectParameters, KickParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.crossings import NO_CROSSINGS, Crossings, joined, merged
from emulator.sensor.pixels.event_time import MOST_EVENTS
from emulator.sensor.pixels.method import MakePixels, PixelMethod
from emulator.sensor.pixels.passages.rounds import MOST_PASSAGES
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Events, Float32s
from transports.registry import imported

if TYPE_CHECKING:
    from emulator.sensor.row_kicks import LineReads, RowKicks


def own_pixels(p: SensorParameters, seed: int, threads: int = 0) -> PixelMethod:
    """Return evstim's own pixels with the effects of the sensor; `threads` as in `PixelArray`."""
    if p.photoreceptor == "circuit":
        reference = "laboratory.methods.circuit:CircuitPixels"
    elif p.noise.rms and p.noise.grade == "grid":
        reference = "laboratory.methods.grid:NoisyPixels"
    else:
        return PixelArray(p, seed, threads)
    pixels: PixelMethod = imported(reference)(p, seed)
    return pixels


def make_readout(p: SensorParameters) -> ReadOut:
    """Return the sensor's read-out, at rest."""
    return ScanReadOut(p) if p.readout.scan_us else ArbiterReadOut(p)


def finished(readout: ReadOut, late: Crossings) -> Events:
    """Return the events that a read-out has not sent yet, with crossings of after the last step."""
    sent = [readout.push(late, int(late.t_ns[-1]) + 1)] if len(late) else []
    return np.concatenate([*sent, readout.finish()])


class EventSource(Protocol):
    """Light in, events out. Every event raised is lost in the pixel, lost at the read-out, or read out."""

    parameters: SensorParameters

    @property
    def raised(self) -> int:
        """Events raised since `reset`."""

    @property
    def lost_in_pixel(self) -> int:
        """Of these, lost in their pixel."""

    @property
    def lost_at_readout(self) -> int:
        """Of these, lost at the arbiter."""

    @property
    def read_out(self) -> int:
        """Of these, returned."""

    @property
    def undersampled_share(self) -> float | None:
        """Share of the solved pixel-steps whose light changed too quickly between two frames; None where unknown."""

    def with_kicks(self, kicks: KickParameters) -> Callable[[LineReads], None] | None:
        """Return the receiver of reads of active pixels, which disturb the events from then on; None where they cannot.

        Each call of the receiver gives the reads that begin in the next step.
        """

    def warm_up(self) -> None:
        """Do the slow work of a first step, such as compiling kernels; later results do not change."""

    def reset(self, frame: LightFrame) -> None:
        """Start at rest on the light of `frame`, at its time."""

    def expose(self, frame: LightFrame) -> Events:
        """Move to the time of `frame` and return the events that leave before it; see `Sensor.expose`."""

    def finish(self) -> Events:
        """Return the events that have not left yet."""


@runtime_checkable
class AdjustableSource(Protocol):
    """A source with parameters that can change between two steps."""

    @property
    def longest_step_ns(self) -> int:
        """Longest step whose work and memory are bounded; see `longest_step_ns`."""

    @property
    def adjustable(self) -> dict[str, float]:
        """Fields of SensorParameters that can change, with their present values."""

    def adjust(self, name: str, value: float) -> None:
        """Set one of them from now on; raises ValueError."""


@runtime_checkable
class ThresholdSource(Protocol):
    """A source whose pixels have thresholds that can be read."""

    def thresholds_of(self, x: int, y: int) -> tuple[float, float]:
        """Return the ON and OFF threshold of a pixel; raises ValueError where there is none."""


_MOST_RANDOM = 1 << 25  # events of a step: 3 GB
_MOST_MOVED = 1 << 29  # pixels of all moves within a step: half a minute
_LIGHTS = np.geomspace(1e-6, 1e6, 60)


def longest_step_ns(p: SensorParameters) -> int:
    """Return the longest step whose work and memory are bounded: seconds for usual sensors, at least 1 us.

    Bounded are the mean number of events that do not come from changing light, of pixels that all are as noisy as in
    the worst light, and the pixels that are moved where the sensor has a grid of times of its own.
    """
    pixels = p.width * p.height
    b, r = p.background, p.radiation
    most_hz = _most_still_hz(p)
    each_hz = most_hz + p.parasitic_hz_at_reference + b.hz + b.hot_share * b.hot_hz
    hot_hz = p.defects.hot_hz * math.exp(p.defects.hot_spread**2 / 2)
    track = (1 + r.off_share) * min(1 + 2 * r.depth_um / r.pixel_pitch_um, p.width + p.height)
    random_hz = pixels * (each_hz + p.defects.hot_share * hot_hz) + hits_per_second(p) * track
    grids_ns = [p.imager.shot_grid_us * 1000] if p.imager.photon_shot_noise or p.imager.dark_shot_noise else []
    if p.noise.rms and p.noise.grade == "grid":
        grids_ns.append(imported("laboratory.methods.grid:grid_ns")(p))
    most_ns = [_MOST_RANDOM / random_hz * 1e9] if random_hz else []
    most_of_pixel = MOST_EVENTS if p.noise.grade == "offsets" else MOST_PASSAGES
    most_ns += [most_of_pixel / 2 / most_hz * 1e9] if p.noise.rms else []
    most_ns += [_MOST_MOVED / pixels * step_ns for step_ns in grids_ns]
    return max(round(min(*most_ns, 2.0**62, 2.0**62)), 1000)


def _most_still_hz(p: SensorParameters) -> float:
    """Return the rate of a pixel's events by noise and leak in the light where noise is most frequent."""
    if not p.noise.rms:
        return p.leak_hz
    f = corner_hz(p, _LIGHTS)
    deviations = min(p.threshold_on, p.threshold_off) / rms(p, f)
    noisiest = np.argmax(np.log(np.minimum(f, fixed_corner_hz(p))) - deviations**2 / 2)
    return sum(still_hz(p, float(f[noisiest])))


class Sensor:
    """A sensor from light to events.

    Raises ValueError where the method of the pixels lacks an effect that the parameters switch on (defects, changing
    leak).

    Parameters
    ----------
    parameters : the sensor and its effects.
    seed : keys all random numbers.
    make_pixels : the method of the pixels.

    Attributes
    ----------
    parameters : as given.
    pixels : the pixels.
    longest_step_ns : longest step whose work and memory are bounded; `expose` takes longer ones too.
    """

    def __init__(self, parameters: SensorParameters, seed: int, make_pixels: MakePixels = own_pixels) -> None:
        self.parameters = parameters
        at_reference = at_temperature(parameters)
        self._imager = Imager(at_reference, seed)
        p = dataclasses.replace(at_reference, dark_current_relative=self._imager.dark_current_relative)
        self.pixels = make_pixels(p, seed)
        self.pixels.capabilities.check(p)
        defects = draw_defects(p, seed)
        self._dead = np.isin(np.arange(p.width * p.height), defects.dead) if defects.dead.size else None
        self._leaks = _leaks(self.pixels, p, seed, defects)
        self._sources: list[SlottedEvents] = []  # beside the pixels
        if p.background.hz or p.background.hot_share * p.background.hot_hz:
            self._sources.append(BackgroundEvents(p, seed, defects.dead))
        if p.radiation.hits_per_cm2_s:
            self._sources.append(Particles(p, seed, defects.dead))
        self._jitter = Jitter(p.jitter, seed, p.width * p.height) if p.jitter.latency_us else None
        self._readout = make_readout(p)
        self._dark = np.float32(at_reference.dark_current_relative)
        self._before, self._way = (np.empty((p.height, p.width), np.float32) for _ in range(2))
        self._t_ns = 0
        self._seed = seed
        self._kicks: RowKicks | None = None
        self._reads: LineReads | None = None
        self.longest_step_ns = longest_step_ns(p)

    def with_kicks(self, kicks: KickParameters) -> Callable[[LineReads], None] | None:
        """Let reads of active pixels disturb the events; None where the method of the pixels cannot.

        Return the receiver of the reads that begin in the next step, from its start on, before its end.
        """
        if not self.pixels.capabilities.takes_row_reads:
            return None
        from emulator.sensor.row_kicks import RowKicks

        self._kicks = RowKicks(kicks, self.parameters, self._seed, self.pixels.levels())
        return self._disturb

    def _disturb(self, reads: LineReads) -> None:
        self._reads = reads

    @property
    def raised(self) -> int:
        """All events raised: lost_in_pixel + lost_at_readout + read_out + pending."""
        return self._readout.raised + self.pixels.lost_in_pixel + self._delayed

    @property
    def lost_in_pixel(self) -> int:
        """Crossings beyond the most that a pixel can have in a step."""
        return self.pixels.lost_in_pixel

    @property
    def lost_at_readout(self) -> int:
        """Crossings of pixels whose request still waited, or that were still busy after the acknowledge."""
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
    def undersampled_share(self) -> float | None:
        """Share of the solved pixel-steps whose light changed unseen between two frames; None where unknown.

        This is the measure of whether frames are close enough together.
        """
        return self.pixels.undersampled_share

    def warm_up(self) -> None:
        """Compile the kernels, or load them from disk, by flashing a light at a few pixels like these."""
        few = dataclasses.replace(self.parameters, width=16, height=16, defects=DefectParameters())
        flashed = Sensor(few, 0)
        dark, bright = np.zeros((16, 16), np.float32), np.ones((16, 16), np.float32)
        flashed.reset(LightFrame(0, dark))
        everything = Region(0, 16, 0, 16, np.array([[0, 16, 0, 16]]))
        flashed.expose(LightFrame(1_000_000, bright, dark, changed=everything))
        flashed.finish()

    def reset(self, frame: LightFrame) -> None:
        """Start at rest on the light of `frame`, at its time; nothing is pending, all counters are zero."""
        self._readout = make_readout(self.parameters)
        self._t_ns = frame.t_ns
        if self._leaks is not None:
            self._leaks.follow(self._t_ns)
        self.pixels.reset(self._imager.see(LightFrame(frame.t_ns, frame.light, frame.rate)))
        if self._kicks is not None:
            self._kicks.reset()
        for source in self._sources:
            source.reset(self._t_ns)
        if self._jitter is not None:
            self._jitter.reset(self._t_ns)
        self._remember(frame.light)

    def expose(self, frame: LightFrame) -> Events:
        """Move to the time of `frame`, and return the events that leave until then, (n,) EVENT, sorted by t.

        Raises ValueError if time goes back, or the frame does not have the sensor's size.
        """
        parts, t0_ns = [], self._t_ns
        after = np.ascontiguousarray(frame.light).reshape(-1)
        while (cut_ns := self._next_cut_ns()) < frame.t_ns:
            share = np.float32((cut_ns - t0_ns) / (frame.t_ns - t0_ns))
            part_of_the_way(self._before.reshape(-1), after, self._dark, share, self._way.reshape(-1))
            cut = LightFrame(cut_ns, self._way, changed=frame.changed)
            moved = self._move(cut)  # of arrays that the next step writes again
            parts.append(dataclasses.replace(moved, **{k: getattr(moved, k).copy() for k in ("t_ns", "pixel", "on")}))
        parts.append(self._move(frame))
        self._remember(frame.light)
        return self._send(joined(parts), self.pixels.settled_ns)

    @property
    def adjustable(self) -> dict[str, float]:
        """Fields of `parameters`, their read-out and jitter that `adjust` can change, with their present values."""
        fixed = {"leak_hz"} if self._leaks is not None else set()  # it has its own course
        fields = {name: value for name, value in self.pixels.adjustable.items() if name not in fixed}
        if isinstance(self._readout, ScanReadOut):
            fields["scan_us"] = self._readout.scan_us
        if self._jitter is not None:
            fields["off_latency_us"] = self._jitter.off_latency_us
        return fields

    def adjust(self, name: str, value: float) -> None:
        """Set one of `adjustable` from now on; the noise follows from the same time on.

        Raises ValueError if the field cannot be changed, or the value is not allowed.
        """
        if name not in self.adjustable:
            raise ValueError(f"{name} cannot be changed while this sensor runs")
        if name in ("scan_us", "off_latency_us") and value == 0:
            raise ValueError(f"{name} must stay above 0 while the sensor runs: at 0 it would be another sensor")
        if name == "scan_us" and isinstance(self._readout, ScanReadOut):
            dataclasses.replace(self.parameters.readout, scan_us=value)  # raises outside its bounds
            self._readout.set_scan_us(value)
        elif name == "off_latency_us" and self._jitter is not None:
            dataclasses.replace(self.parameters.jitter, off_latency_us=value)
            self._jitter.set_off_latency(value)
        else:
            self.pixels.adjust(name, value)
            self.longest_step_ns = longest_step_ns(self.pixels.parameters)
            if name == "refractory_us":
                self._set_refractory(value)

    def thresholds_of(self, x: int, y: int) -> tuple[float, float]:
        """Return the ON and OFF threshold of a pixel, ln units; infinite for a dead pixel.

        Raises ValueError if the sensor has no such pixel, or its method has no thresholds that can be read.
        """
        width, height = self.parameters.width, self.parameters.height
        if not (0 <= x < width and 0 <= y < height):
            raise ValueError(f"there is no pixel ({x}, {y}): the sensor has {width} x {height}")
        if not self.pixels.capabilities.is_adjustable:
            raise ValueError("the thresholds of this sensor's pixels cannot be read")
        return self.pixels.thresholds_of(y * width + x)

    def _set_refractory(self, refractory_us: float) -> None:
        self._readout.set_refractory(refractory_us)

    def finish(self) -> Events:
        """Return the events that have not left yet; the sensor cannot be exposed afterwards."""
        return finished(self._readout, self._rest())

    def _rest(self) -> Crossings:
        """Return the crossings that have not reached the read-out."""
        late = NO_CROSSINGS if self._kicks is None else self._of_live_pixels(self._kicks.rest())
        if self._jitter is None:
            return late
        begun = self._jitter.step(late, int(late.t_ns[-1]) + 1) if len(late) else late
        return joined([begun, self._jitter.step(NO_CROSSINGS, self._jitter.last_ns() + 1)])

    def _next_cut_ns(self) -> int:
        """Return the next time at which a step must end."""
        grid_ns = self._imager.grid_ns
        shot_ns = (self._t_ns // grid_ns + 1) * grid_ns if grid_ns else NEVER_NS
        return min(shot_ns, self._leaks.next_ns) if self._leaks is not None else shot_ns

    def _move(self, frame: LightFrame) -> Crossings:
        """Move all parts to the time of `frame`; no cut lies in between."""
        if self._leaks is not None and self._leaks.next_ns <= self._t_ns:
            self._leaks.follow(self._t_ns)
        seen = self._imager.see(frame)
        crossings = self._of_live_pixels(self.pixels.step(seen) if self._kicks is None else self._kicked(seen))
        self._t_ns = frame.t_ns
        return self._with_others(crossings, seen.light, self.pixels.settled_ns)

    def _kicked(self, seen: LightFrame) -> Crossings:
        """Return the pixels' crossings, disturbed by the reads of active pixels."""
        assert self._kicks is not None
        groups = [] if self._reads is None else self._kicks.begin(self._reads.between(self._t_ns, seen.t_ns))
        return self._kicks.end(groups, self.pixels.step(seen), self._t_ns, seen.t_ns)

    def _with_others(self, crossings: Crossings, seen: Float32s, settled_ns: int) -> Crossings:
        """Return the pixels' crossings as they are raised, delayed, with the events of other sources."""
        if self._jitter is not None:
            crossings = self._jitter.step(crossings, settled_ns)
        for source in self._sources:
            crossings = merged(crossings, source.step(settled_ns))
        return crossings

    def _send(self, crossings: Crossings, settled_ns: int) -> Events:
        """Return the events that leave before `settled_ns`, up to which `crossings` are all."""
        return self._readout.push(crossings, settled_ns)

    def _of_live_pixels(self, crossings: Crossings) -> Crossings:
        """Return the crossings without those of dead pixels."""
        if self._dead is None:
            return crossings
        live = ~self._dead[crossings.pixel]
        return Crossings(crossings.t_ns[live], crossings.pixel[live], crossings.on[live], crossings.lost_in_pixel)

    def _remember(self, light: Float32s) -> None:
        """Store the last frame, if a step may have to be cut."""
        if self._next_cut_ns() < NEVER_NS:
            self._before[:] = light


def _leaks(pixels: PixelMethod, p: SensorParameters, seed: int, defects: Defects) -> Leaks | None:
    """Apply the defects to the pixels; return the changing leak, None where it is constant."""
    if not (defects.hot.size or defects.dead.size or p.jitter.leak_share):
        return None
    if not pixels.capabilities.has_faults:
        raise ValueError("defects, dose and jitter.leak_share need evstim's own pixels: leave them out, or the method")
    pixels.kill(defects.dead)
    return Leaks(pixels, seed, p.jitter.leak_share, defects)
