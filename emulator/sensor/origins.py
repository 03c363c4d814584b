"""A sensor that tells of each of its events what raised it.

The events are those of `Sensor`, to the last bit. The code of an origin has three bits, and each bit travels as the
polarity of one more list of crossings, with the same times and pixels, through a delay and a read-out of its own: what
these do never depends on polarity, so the bits come out in the order of the events.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.sensor.chip.background import BackgroundEvents
from emulator.sensor.chip.radiation import Particles
from emulator.sensor.chip.temperature import at_temperature
from emulator.sensor.leak_share import LeakShare
from emulator.sensor.noise.grid import NoisyPixels
from emulator.sensor.noise.point_process import NoiseEvents
from emulator.sensor.origin_codes import Origin
from emulator.sensor.parts import finished, make_jitter, make_readout
from emulator.sensor.pixels.array import Crossings, PixelArray
from emulator.sensor.pixels.merging import joined, merged
from emulator.sensor.pixels.mismatch import draw
from emulator.sensor.presets import SensorParameters
from emulator.sensor.sensor import MakePixels, Sensor
from firmware_protocol.events import Events

__all__ = ["TracedSensor"]

_BITS = 3

_Codes = npt.NDArray[np.uint8]
_Float32s = npt.NDArray[np.float32]


_OF_SOURCES: dict[type[Any], Origin] = {
    NoiseEvents: Origin.NOISE,
    BackgroundEvents: Origin.BACKGROUND,
    Particles: Origin.PARTICLE,
}


class TracedSensor(Sensor):
    """A `Sensor`, with the same parameters, whose events have origins.

    Attributes
    ----------
    origins : (n,) uint8, `Origin` of each event that the last `expose` or `finish` returned.
    """

    def __init__(self, parameters: SensorParameters, seed: int, make_pixels: MakePixels = PixelArray) -> None:
        super().__init__(parameters, seed, make_pixels)
        self.origins: _Codes = np.empty(0, np.uint8)
        here, self._seed = at_temperature(parameters), seed
        self._bits: list[list[Crossings]] = []
        self._drawn = draw(here, seed)
        start = np.asarray(self._drawn.phase, np.float64)
        self._leak = LeakShare(start, round(here.refractory_us * 1000), here.parasitic_hz_at_reference)
        self._constant_hz = self._leak_hz()
        self._make_twins()

    def reset(self, light: _Float32s, t_ns: int) -> None:
        """Start as `Sensor.reset` does."""
        super().reset(light, t_ns)
        self._leak.reset(self._imager.see(light, int(t_ns)), int(t_ns))
        self._bits, self.origins = [], np.empty(0, np.uint8)
        self._make_twins()

    def finish(self) -> Events:
        """Return the events that have not left yet."""
        events = super().finish()
        twins = zip(self._jitters, self._readouts, strict=True)
        self.origins = _codes([finished(jitter, readout) for jitter, readout in twins])
        return events

    def _make_twins(self) -> None:
        p = at_temperature(self.parameters)
        self._jitters = [make_jitter(p, self._seed) for _ in range(_BITS)]
        for jitter in self._jitters:
            if jitter is not None:
                jitter.reset(self._t_ns)
        self._readouts = [make_readout(self.parameters) for _ in range(_BITS)]

    def _with_others(self, crossings: Crossings, seen: _Float32s, settled_ns: int) -> Crossings:
        bits = _bits(crossings, self._of_pixels(crossings, seen, settled_ns))
        if self._jitter is not None:
            crossings = self._jitter.step(crossings, settled_ns)
            bits = [
                b if jitter is None else jitter.step(b, settled_ns)
                for jitter, b in zip(self._jitters, bits, strict=True)
            ]
        for source in self._sources:
            own = source.step(seen.reshape(-1), settled_ns)
            codes = np.full(len(own), _OF_SOURCES.get(type(source), Origin.UNKNOWN), np.uint8)
            crossings = merged(crossings, own)
            bits = [merged(a, b) for a, b in zip(bits, _bits(own, codes), strict=True)]
        self._bits.append([dataclasses.replace(b, t_ns=b.t_ns.copy(), pixel=b.pixel.copy()) for b in bits])
        return crossings

    def _send(self, crossings: Crossings, settled_ns: int) -> Events:
        events = super()._send(crossings, settled_ns)
        parts, self._bits = list(zip(*self._bits, strict=True)), []
        sent = [out.push(joined(part), settled_ns) for out, part in zip(self._readouts, parts, strict=True)]
        self.origins = _codes(sent)
        return events

    def _of_pixels(self, crossings: Crossings, seen: _Float32s, settled_ns: int) -> _Codes:
        """Return the codes of what the pixels raised up to `settled_ns`."""
        if self._constant_hz is None:
            return np.full(len(crossings), Origin.UNKNOWN, np.uint8)
        hz = self._constant_hz if self._leaks is None else self._leak_hz()
        leaks = self._leak.step(crossings, self._constant_hz if hz is None else hz, seen, settled_ns)
        return np.where(leaks, np.uint8(Origin.LEAK), np.uint8(Origin.SIGNAL))

    def _leak_hz(self) -> npt.NDArray[np.float64] | None:
        """Return each pixel's leak rate, without the parasitic one; None where it cannot be told from other things."""
        if isinstance(self.pixels, NoisyPixels):
            return None
        if self.pixels.renderer is not None:  # pixels on a graphics card
            return np.asarray(self._drawn.leak / self._drawn.on)
        faults = self.pixels.faults()
        return None if faults is None else faults.leak_hz()


def _bits(crossings: Crossings, codes: _Codes) -> list[Crossings]:
    """Return the crossings once for each bit of the codes, which is their polarity."""
    return [dataclasses.replace(crossings, on=(codes >> k & 1).astype(np.bool_)) for k in range(_BITS)]


def _codes(bits: list[Events]) -> _Codes:
    """Return the codes whose bits are the polarities of lists of the same events."""
    return np.asarray(sum(one["on"].astype(np.uint8) << k for k, one in enumerate(bits)), np.uint8)
