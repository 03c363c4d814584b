"""A sensor that reports the origin of each of its events.

The events are those of `Sensor`, to the last bit. The code of an origin has three bits, and each bit travels as the
polarity of one more list of crossings, with the same times and pixels, through a read-out of its own: it never depends
on polarity, so the bits come out in the order of the events. Through the delay, which does, codes go by pixel.

The origin "noise" is one of the pixel itself: the signal had gone less than half of the way from the level at which the
reference was set to the threshold. It comes first; an event of noise is not the leak's.

The origin "leak" is a definition, because leak and light move one comparator together. An ON event is the leak's if,
since the pixel's reference was last read, the leak has moved the comparator further than the light has: by more than
half of the ON threshold, and before a pixel's first event by more than half of the part that the random start left.
Else it is the signal's. OFF events are always the signal's, because the leak works against them. The motion by leak is
its rate times the time since the reference was read (at an event, and the refractory period behind it), the parasitic
leak by the mean of the light before and after each step.
"""

from __future__ import annotations

import dataclasses
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.light import LightFrame
from emulator.sensor.chip.defects import at_temperature
from emulator.sensor.chip.readout import Arrivals
from emulator.sensor.chip.sources import BackgroundEvents, Particles
from emulator.sensor.numerics.compiled import SOURCES
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.crossings import Crossings, joined, merged
from emulator.sensor.pixels.method import MakePixels
from emulator.sensor.pixels.state import draw
from emulator.sensor.presets import SensorParameters
from emulator.sensor.sensor import Sensor, finished, make_readout, own_pixels
from firmware_protocol.compiled import entry_of
from firmware_protocol.events import Bytes, Events, Float32s, Floats, Mask

_entry = entry_of(__name__, *SOURCES)


class Origin(IntEnum):
    """Origin of an event.

    UNKNOWN is an event of pixels in which noise and light move one comparator (noise of the grid grade) or which follow
    another simulator's rule; SIGNAL and LEAK are distinguished by the definition in `leak_share`.
    """

    UNKNOWN = 0
    SIGNAL = 1
    LEAK = 2
    NOISE = 3
    BACKGROUND = 4
    PARTICLE = 5


class LeakShare:
    """Share of each pixel's ON threshold by which its leak has moved since the reference was read.

    Parameters
    ----------
    start : (pixels,), the share of the ON threshold by which the first reference lies below the first light.
    refractory_ns : time from an event until the reference is read.
    parasitic_hz : rate that light 1 adds.
    """

    def __init__(self, start: Floats, refractory_ns: int, parasitic_hz: float) -> None:
        self._start = start
        self._refractory_ns = refractory_ns
        self._parasitic_hz = parasitic_hz
        self._share, self._half, self._rate_hz = (np.zeros_like(start) for _ in range(3))
        self._light = np.zeros(start.size, np.float32)
        self._t_ns = 0

    def reset(self, light: Float32s, t_ns: int) -> None:
        """Start at `t_ns` on `light`, (height, width)."""
        self._share[:] = 0
        self._half[:] = (1 - self._start) / 2
        self._t_ns = t_ns
        self._light[:] = light.reshape(-1)

    def step(self, crossings: Crossings, leak_hz: Floats, light: Float32s, t_ns: int) -> Mask:
        """Move to `t_ns`; return which of the crossings on the way are the leak's.

        Parameters
        ----------
        leak_hz : (pixels,), without the parasitic leak.
        light : (height, width) at `t_ns`.
        """
        np.copyto(self._rate_hz, leak_hz)
        if self._parasitic_hz:
            flat = light.reshape(-1)
            self._rate_hz += self._parasitic_hz / 2 * np.nan_to_num(np.maximum(self._light, 0) + np.maximum(flat, 0))
            self._light[:] = flat
        leaks = np.empty(len(crossings), np.bool_)
        arrivals = Arrivals(crossings.t_ns, crossings.pixel, crossings.on)
        _step(arrivals, _Interval(self._t_ns, t_ns, self._refractory_ns), self._rate_hz, self._share, self._half, leaks)
        self._t_ns = t_ns
        return leaks


class _Interval(NamedTuple):
    """A step, and the time after an event until the reference is read."""

    t0_ns: int
    t1_ns: int
    refractory_ns: int


@_entry
def _step(crossings: Arrivals, interval: _Interval, rate_hz: Floats, share: Floats, half: Floats, leaks: Mask) -> None:
    """Write which crossings are the leak's, and move `share` to the end; `half` is half of the next event's way."""
    t0_ns = interval.t0_ns
    for k in range(crossings.t_ns.size):
        t_ns, p = crossings.t_ns[k], crossings.pixel[k]
        leaks[k] = crossings.on[k] and share[p] + rate_hz[p] * (t_ns - t0_ns) * 1e-9 > half[p]
        half[p] = 0.5
        share[p] = -rate_hz[p] * (t_ns + interval.refractory_ns - t0_ns) * 1e-9  # 0 when the reference is read
    moved_s = (interval.t1_ns - t0_ns) * 1e-9
    for p in range(share.size):
        share[p] += rate_hz[p] * moved_s


_BITS = 3
_PIXEL_BITS = 24

_Codes = Bytes

_OF_SOURCES: dict[type[Any], Origin] = {BackgroundEvents: Origin.BACKGROUND, Particles: Origin.PARTICLE}


class TracedSensor(Sensor):
    """A `Sensor`, with the same parameters, whose events have origins.

    `origins`: (n,) uint8, `Origin` of each event that the last `expose` or `finish` returned.
    """

    def __init__(self, parameters: SensorParameters, seed: int, make_pixels: MakePixels = own_pixels) -> None:
        super().__init__(parameters, seed, make_pixels)
        self.origins: _Codes = np.empty(0, np.uint8)
        p = at_temperature(parameters)
        self._bits: list[list[Crossings]] = []
        start = np.asarray(draw(p, seed).phase, np.float64)
        self._leak = LeakShare(start, round(p.refractory_us * 1000), p.parasitic_hz_at_reference)
        self._constant_hz = self._leak_hz()
        self._make_twins()

    def reset(self, frame: LightFrame) -> None:
        """Start as `Sensor.reset` does."""
        super().reset(frame)
        self._leak.reset(self._imager.see(frame).light, frame.t_ns)
        self._bits, self.origins = [], np.empty(0, np.uint8)
        self._make_twins()

    def finish(self) -> Events:
        """Return the events that have not left yet."""
        late = self._rest()
        bits = _bits(late, self._codes_behind_delay(np.empty(0, np.uint8), np.empty(0, np.uint32), late.pixel))
        self.origins = _codes([finished(out, b) for out, b in zip(self._readouts, bits, strict=True)])
        return finished(self._readout, late)

    def _make_twins(self) -> None:
        self._readouts = [make_readout(self.parameters) for _ in range(_BITS)]
        self._waiting_codes, self._waiting_pixels = np.empty(0, np.uint8), np.empty(0, np.uint32)

    def _set_refractory(self, refractory_us: float) -> None:
        super()._set_refractory(refractory_us)
        for readout in self._readouts:
            readout.set_refractory(refractory_us)

    def _with_others(self, crossings: Crossings, seen: Float32s, settled_ns: int) -> Crossings:
        codes = self._of_pixels(crossings, seen, settled_ns)
        if self._jitter is not None:
            pixels = crossings.pixel.copy()
            crossings = self._jitter.step(crossings, settled_ns)
            codes = self._codes_behind_delay(codes, pixels, crossings.pixel)
        bits = _bits(crossings, codes)
        for source in self._sources:
            raised = source.step(settled_ns)
            codes = np.full(len(raised), _OF_SOURCES.get(type(source), Origin.UNKNOWN), np.uint8)
            crossings = merged(crossings, raised)
            bits = [merged(a, b) for a, b in zip(bits, _bits(raised, codes), strict=True)]
        self._bits.append([dataclasses.replace(b, t_ns=b.t_ns.copy(), pixel=b.pixel.copy()) for b in bits])
        return crossings

    def _codes_behind_delay(
        self, codes: _Codes, pixels: npt.NDArray[np.uint32], leaving: npt.NDArray[np.uint32]
    ) -> _Codes:
        """Return the codes of crossings that leave the delay, by their pixels.

        `codes` and `pixels` are those that enter it now. The delay, which depends on polarity, keeps the order of each
        pixel. Crossings that kicks add at the end of the stream count as the signal's.
        """
        codes, pixels = np.append(self._waiting_codes, codes), np.append(self._waiting_pixels, pixels)
        waiting, order = np.argsort(pixels, kind="stable"), np.argsort(leaving, kind="stable")
        by_pixel = leaving[order]
        number = np.arange(by_pixel.size) - np.searchsorted(by_pixel, by_pixel)  # of those of its pixel that leave now
        place = np.searchsorted(pixels[waiting], by_pixel) + number
        left = np.full(by_pixel.size, Origin.SIGNAL, np.uint8)
        has_code = place < np.searchsorted(pixels[waiting], by_pixel, side="right")
        left[order[has_code]] = codes[waiting[place[has_code]]]
        stays = np.ones(codes.size, np.bool_)
        stays[waiting[place[has_code]]] = False
        self._waiting_codes, self._waiting_pixels = codes[stays], pixels[stays]
        return left

    def _send(self, crossings: Crossings, settled_ns: int) -> Events:
        events = super()._send(crossings, settled_ns)
        parts, self._bits = list(zip(*self._bits, strict=True)), []
        sent = [out.push(joined(part), settled_ns) for out, part in zip(self._readouts, parts, strict=True)]
        self.origins = _codes(sent)
        return events

    def _of_pixels(self, crossings: Crossings, seen: Float32s, settled_ns: int) -> _Codes:
        """Return the codes of the crossings that the pixels raised up to `settled_ns`."""
        if self._constant_hz is None:
            return np.full(len(crossings), Origin.UNKNOWN, np.uint8)
        hz = self._constant_hz if self._leaks is None else self._leak_hz()
        leaks = self._leak.step(crossings, self._constant_hz if hz is None else hz, seen, settled_ns)
        codes = np.where(leaks, np.uint8(Origin.LEAK), np.uint8(Origin.SIGNAL))
        if isinstance(self.pixels, PixelArray) and len(self.pixels.of_noise):
            listed = (crossings, self.pixels.of_noise)
            keys, of_noise = ((c.t_ns - self._t_ns << _PIXEL_BITS) | c.pixel.astype(np.int64) for c in listed)
            codes[np.isin(keys, of_noise)] = Origin.NOISE
        return codes

    def _leak_hz(self) -> Floats | None:
        """Return each pixel's leak rate, without the parasitic one; None where unknown or inseparable from noise."""
        capabilities = self.pixels.capabilities
        return None if capabilities.has_grid_noise or not capabilities.has_faults else self.pixels.leak_hz()


def _bits(crossings: Crossings, codes: _Codes) -> list[Crossings]:
    """Return the crossings once for each bit of the codes, which is their polarity."""
    return [dataclasses.replace(crossings, on=(codes >> k & 1).astype(np.bool_)) for k in range(_BITS)]


def _codes(bits: list[Events]) -> _Codes:
    """Return the codes whose bits are the polarities of lists of the same events."""
    return np.asarray(sum(events["on"].astype(np.uint8) << k for k, events in enumerate(bits)), np.uint8)
