"""The sweeps of a characterisation, coarse or fine."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from emulator.characterise.curves import leak_light, leak_spread, leak_temperature, s_curve, spread
from emulator.characterise.points import FIGURE, Point
from emulator.characterise.stimuli import on_the_bench, without_readout
from emulator.characterise.timing import burst, flicker, latency, noise_law, noise_light
from emulator.sensor.chip.temperature import at_temperature
from emulator.sensor.effects import BackgroundParameters
from emulator.sensor.noise.law import corner_hz, fixed_corner_hz
from emulator.sensor.presets import SensorParameters

__all__ = ["CONFIGURED", "Measurement", "figures", "measurements"]

Measurement = Callable[[], list[Point]]

CONFIGURED = "as configured"
"""Name of the series that has the sensor's own figures."""

_EXAMPLE = "example: parasitic leak that light 1 makes as large"
_MISMATCHES = {"mismatch 2.1 %": 0.021, "mismatch 10 %": 0.1}
_RMS = (0.043, 0.073)
_CONTRASTS = (0.4, 0.7, 1.5)
_DEAD_US = (100.0, 500.0)
_LAW_LIGHT = 0.1
_MOST_CORNERS = 30  # corner frequencies: nothing is left of a faster flicker


@dataclasses.dataclass(frozen=True)
class _Sweep:
    """How finely each thing is swept."""

    deviations: int
    celsius: Sequence[float]
    lights: int
    leak_s: float
    noise_s: float
    a: Sequence[float]
    flicker: int
    burst: Sequence[int]


_QUICK = _Sweep(7, (0, 20, 40), 6, 20.0, 4.0, (2.5, 3, 3.5, 4), 8, (100, 1000, 10_000))
_FULL = _Sweep(
    19, (-20, -10, 0, 10, 20, 30, 40, 50, 60), 16, 60.0, 20.0, (2.25, 2.5, 2.75, 3, 3.25, 3.5, 3.75, 4, 4.25), 24,
    (10, 100, 1000, 3000, 10_000, 30_000, 100_000, 300_000, 900_000),
)  # fmt: skip


def measurements(p: SensorParameters, quick: bool) -> list[Measurement]:
    """Return what is to be measured of a sensor, each a call of its own."""
    sweep, small, still = _QUICK if quick else _FULL, on_the_bench(p), _silent(p)
    alone = on_the_bench(still)
    return [*_thresholds(alone, sweep), *_leak(alone, sweep), *_noise(small, sweep), *_timing(alone, still, sweep)]


def _silent(p: SensorParameters) -> SensorParameters:
    """Return the sensor without noise and background, which hide what is measured of thresholds, leak and times."""
    return dataclasses.replace(p, noise=dataclasses.replace(p.noise, rms=0.0), background=BackgroundParameters())


def _thresholds(p: SensorParameters, sweep: _Sweep) -> Iterator[Measurement]:
    deviations = np.linspace(-3, 3, sweep.deviations)
    configured = {CONFIGURED: p.mismatch} if p.mismatch else {}
    for series, mismatch in {**configured, **_MISMATCHES}.items():
        for some in np.array_split(deviations, 3):
            yield partial(s_curve, p, series, mismatch, some)
    yield partial(spread, p)


def _leak(p: SensorParameters, sweep: _Sweep) -> Iterator[Measurement]:
    for celsius in sweep.celsius:
        yield partial(leak_temperature, p, CONFIGURED, celsius, sweep.leak_s)
    example = dataclasses.replace(p, parasitic_hz_at_reference=p.leak_hz)
    for light in np.geomspace(1e-4, 10, sweep.lights):
        yield partial(leak_light, p, CONFIGURED, float(light), sweep.leak_s)
        if p.parasitic_hz_at_reference == 0 and p.leak_hz:
            yield partial(leak_light, example, _EXAMPLE, float(light), sweep.leak_s)
    yield partial(leak_spread, p, sweep.leak_s)


def _noise(p: SensorParameters, sweep: _Sweep) -> Iterator[Measurement]:
    if math.isinf(fixed_corner_hz(p)) and math.isinf(min(p.corner_hz_at_reference, p.corner_max_hz)):
        return  # nothing limits a noise's bandwidth
    swept = {CONFIGURED: p.noise.rms} if p.noise.rms else {f"noise {rms:g} rms": rms for rms in _RMS}
    for series, rms in swept.items():
        yield partial(_figure, "noise swept, ln rms", rms)
        for light in np.geomspace(1e-4, 10, sweep.lights):
            yield partial(noise_light, p, series, rms, float(light), sweep.noise_s)
    for a in sweep.a:
        yield partial(noise_law, p, CONFIGURED, a, _LAW_LIGHT, sweep.noise_s)


def _figure(name: str, value: float) -> list[Point]:
    return [Point(FIGURE, name, 0, value)]


def _timing(p: SensorParameters, whole: SensorParameters, sweep: _Sweep) -> Iterator[Measurement]:
    for contrast in _CONTRASTS:
        for light in np.geomspace(1e-4, 10, sweep.lights):
            yield partial(latency, p, contrast, float(light))
    for pixels in sweep.burst:
        if pixels <= whole.width * whole.height:
            yield partial(burst, whole, pixels, (whole.width, whole.height))
    alone = without_readout(p)
    for hz in np.geomspace(1, 30_000, sweep.flicker):
        for told, light in (("1 klux", 1.0), ("10 lux", 1e-2), ("0.1 lux", 1e-4)):
            if hz < _MOST_CORNERS * corner_hz(at_temperature(p), light):
                yield partial(flicker, alone, "flicker_events", told, float(hz), light)
        for dead_us in dict.fromkeys((p.refractory_us, *_DEAD_US)):
            one = dataclasses.replace(alone, refractory_us=dead_us)
            yield partial(flicker, one, "flicker_rate", f"dead time {dead_us:g} us", float(hz), 1.0)


def figures(points: Sequence[Point]) -> list[Point]:
    """Return the single figures that follow from the curves: the leak's doubling and the read-out's speed."""
    found = []
    warm = sorted((q.x, q.y) for q in points if q.curve == "leak_temperature" and q.y > 0)
    if len(warm) > 1:
        slope = np.polyfit([x for x, _ in warm], np.log2([y for _, y in warm]), 1)[0]
        found.append(Point(FIGURE, "leak doubles every, K", 0, float(1 / slope)))
    bursts = [(q.x, q.y) for q in points if q.curve == "burst" and q.y > 0]
    if bursts:
        pixels, us = max(bursts)
        found.append(Point(FIGURE, "read-out, Mev/s", 0, pixels / us))
    return found
