"""Measurements of a characterisation: thresholds, leak, noise, latency and dead time, in sweeps, coarse or fine.

Each function measures one point or one line with a fresh `Bench`, and gives the values of the equations beside it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
import numpy.typing as npt

from emulator.sensor.chip.defects import at_temperature
from emulator.sensor.noise.law import corner_hz, fixed_corner_hz, still_hz
from emulator.sensor.parameters import BackgroundParameters
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Floats, Int64s, Mask
from laboratory.characterise.stimuli import (
    FIGURE,
    Bench,
    Point,
    lag_s,
    lags_s,
    log_current,
    on_the_bench,
    settled,
    without_readout,
)

_S = 1_000_000_000
_STEP_WAIT_TAUS = 20
_LEAST_WAIT_S = 1e-3
_RAMP_SPAN = 4.0  # ln
_RAMP_RATE = 100.0  # ln a second: leak is negligible beside it
_BRIGHT = 2.0  # lowest light of that ramp: the filter is at its fastest
_BINS = 41


def s_curve(p: SensorParameters, series: str, mismatch: float, deviations: Floats, light: float = 1.0) -> list[Point]:
    """Return the share of pixels that respond to a contrast step, ON and OFF, at steps around the threshold.

    The model is the normal distribution of the thresholds.
    """
    p = dataclasses.replace(p, mismatch=mismatch)
    points = []
    for curve, threshold, sign in (("s_curve_on", p.threshold_on, 1), ("s_curve_off", p.threshold_off, -1)):
        for deviation in deviations:
            contrast = threshold * (1 + mismatch * deviation)
            share = _responding(p, sign * contrast, light)
            points.append(Point(curve, series, contrast, share, model=_normal(deviation)))
    return points


def _responding(p: SensorParameters, contrast: float, light: float) -> float:
    """Return the share of the pixels that send an event of the step's sign, one or more."""
    bench = settled(without_readout(p), light)
    after = np.exp(log_current(p, bench.light) + contrast) - np.exp(log_current(p, 0))
    bench.jump(after)
    bench.hold(round(max(_LEAST_WAIT_S, _STEP_WAIT_TAUS * float(lag_s(p, after).max())) * _S))
    events = bench.finish()
    return np.unique(bench.pixel(events[events["on"] == (contrast > 0)])).size / bench.light.size


def _normal(above: float, deviation: float = 1.0) -> float:
    """Return the share of a normal distribution that is not farther than `above` over its mean."""
    return 0.5 * (1 + math.erf(above / (deviation * math.sqrt(2)))) if deviation else float(above >= 0)


def spread(p: SensorParameters) -> list[Point]:
    """Return the distribution of the pixels' thresholds, measured by the gaps between events on a fast ramp.

    The model is the share of a normal distribution that falls into each bin.
    """
    points = []
    for series, on, nominal in (("ON", True, p.threshold_on), ("OFF", False, p.threshold_off)):
        thresholds, deviation = _thresholds(p, on), p.mismatch * nominal
        edges = nominal + np.linspace(-1, 1, _BINS) * max(4 * deviation, 0.02 * nominal)
        points += _histogram(
            "spread", series, thresholds, edges, [_normal(edge - nominal, deviation) for edge in edges]
        )
        mean, spread_here = float(np.mean(thresholds)), float(np.std(thresholds))
        points += [
            Point(FIGURE, f"threshold {series}, ln", 0, mean, model=nominal),
            Point(FIGURE, f"mismatch {series}, share", 0, spread_here / mean, model=p.mismatch),
        ]
    return points


def _thresholds(p: SensorParameters, on: bool) -> Floats:
    """Return each pixel's threshold: contrast rate times the median gap, less the dead time, ln."""
    low, high = (log_current(p, light) for light in (_BRIGHT, _BRIGHT * math.exp(_RAMP_SPAN)))
    start, end = (low, high) if on else (high, low)
    bench = Bench(without_readout(p), np.exp(start) - np.exp(log_current(p, 0)))
    steps = 50
    for k in range(1, steps + 1):
        light = np.exp(start + (end - start) * k / steps) - np.exp(log_current(p, 0))
        bench.ramp(light, round(_RAMP_SPAN / _RAMP_RATE / steps * _S))
    events = bench.finish()
    gap_us = np.array([np.median(np.diff(t)) for t in _times_us(bench, events[events["on"] == on]) if t.size > 2])
    return np.asarray((gap_us - p.refractory_us) * 1e-6 * _RAMP_RATE)


def _times_us(bench: Bench, events: npt.NDArray[np.void]) -> list[Int64s]:
    """Return the times of each pixel's events, pixel by pixel, us."""
    pixel = bench.pixel(events)
    order = np.argsort(pixel, kind="stable")
    cuts = np.flatnonzero(np.diff(pixel[order])) + 1
    return np.split(events["t"][order].astype(np.int64), cuts)


def _histogram(curve: str, series: str, values: Floats, edges: Floats, below: Sequence[float]) -> list[Point]:
    """Return the share of the values in each bin, beside a distribution by its share below each edge."""
    shares = np.histogram(values, edges)[0] / values.size
    middles, models = (edges[1:] + edges[:-1]) / 2, np.diff(below)
    return [
        Point(curve, series, float(x), float(y), model=float(model))
        for x, y, model in zip(middles, shares, models, strict=True)
    ]


def leak_temperature(p: SensorParameters, series: str, celsius: float, for_s: float) -> list[Point]:
    """Return the rate of leak events of a pixel at a temperature of the chip, in the dark."""
    warm = dataclasses.replace(p, temperature=dataclasses.replace(p.temperature, celsius=celsius))
    model = p.leak_hz * warm.temperature.leak_factor
    model += p.parasitic_hz_at_reference * float(np.exp(log_current(warm, 0)))
    return [Point("leak_temperature", series, celsius, *_leak_hz(warm, 0.0, for_s), model)]


def leak_light(p: SensorParameters, series: str, light: float, for_s: float) -> list[Point]:
    """Return the rate of leak events of a pixel in a light."""
    model = p.leak_hz * p.temperature.leak_factor
    model += p.parasitic_hz_at_reference * float(np.exp(log_current(p, light)))
    return [Point("leak_light", series, light, *_leak_hz(p, light, for_s), model)]


def _leak_hz(p: SensorParameters, light: float, for_s: float) -> tuple[float, float, float]:
    """Return the mean rate of events in still light without temporal noise, and 5 % and 95 % of the pixels' rates."""
    bench = Bench(without_readout(_noiseless(p)), light)
    bench.hold(round(for_s * _S), steps=math.ceil(for_s))
    counts = np.bincount(bench.pixel(bench.finish()), minlength=bench.light.size) / for_s
    return float(counts.mean()), float(np.percentile(counts, 5)), float(np.percentile(counts, 95))


def leak_spread(p: SensorParameters, for_s: float) -> list[Point]:
    """Return the distribution of the pixels' leak rates, by the gaps between their events; log-normal is the model.

    Pixels with fewer than two events in the time are left out: with a rate below 1 / `for_s`, that is most.
    """
    bench = Bench(without_readout(_noiseless(p)), 0.0)
    bench.hold(round(for_s * _S), steps=math.ceil(for_s))
    times = [t for t in _times_us(bench, bench.finish()) if t.size > 1]
    if not times:
        return []
    rates_hz = np.array([1e6 * (t.size - 1) / (t[-1] - t[0]) for t in times])
    deviation = float(np.std(np.log(rates_hz)))
    edges = np.linspace(0, float(np.percentile(rates_hz, 99.5)), _BINS)
    middle = at_temperature(p).leak_hz * math.exp(-(p.leak_spread**2) / 2)
    below = [0.0, *(_normal(math.log(edge / middle), p.leak_spread) for edge in edges[1:])]
    return [
        *_histogram("leak_spread", "as configured", rates_hz, edges, below),
        Point(FIGURE, "spread of leak between pixels, ln", 0, deviation, model=p.leak_spread),
    ]


def _noiseless(p: SensorParameters) -> SensorParameters:
    return dataclasses.replace(p, noise=dataclasses.replace(p.noise, rms=0.0))


_LATENCY_WAIT_TAUS = 15
_MOST_PIXELS = 0.9

_NOISE_STEP_S = 0.1
_SETTLED_S = 30.0
_FLICKER = math.log(10)
_PARTS = 8  # of half a period
_SETTLE_TAUS = 8
_COUNTED = 4  # periods at least
_COUNTED_DEAD_TIMES = 20  # so that the one at the edge does not count
_FLASH = 3.0  # ln: over every threshold


def noise_light(p: SensorParameters, series: str, noise_rms: float, light: float, for_s: float) -> list[Point]:
    """Return the event rates of a pixel from temporal noise alone, ON and OFF, in still light."""
    p = _with_noise(p, noise_rms)
    model = sum(still_hz(p, float(corner_hz(at_temperature(p), light))))
    return [Point("noise_light", series, light, sum(_noise_hz(p, light, for_s)), model=model)]


def _with_noise(p: SensorParameters, noise_rms: float) -> SensorParameters:
    """Return the sensor with that noise and no leak, so that all it sends in still light is noise.

    Noise has acted before: references at random phases would add a burst, which the law's lasting rate leaves out.
    """
    noise = dataclasses.replace(p.noise, rms=noise_rms, history_s=max(p.noise.history_s, _SETTLED_S))
    return dataclasses.replace(p, noise=noise, leak_hz=0.0, parasitic_hz_at_reference=0.0)


def _noise_hz(p: SensorParameters, light: float, for_s: float) -> tuple[float, float]:
    """Return the ON and the OFF rate of a pixel in still light."""
    bench = Bench(without_readout(p), light)
    bench.hold(round(for_s * _S), steps=math.ceil(for_s / _NOISE_STEP_S))
    on = bench.finish()["on"]
    each_s = for_s * bench.light.size
    return float(np.count_nonzero(on)) / each_s, float(np.count_nonzero(~on)) / each_s


def latency(p: SensorParameters, contrast: float, light: float) -> list[Point]:
    """Return the latency of a pixel's first event after a step up to a light, and the bandwidth that follows from it.

    `light` is that after the step, which sets the filter's speed; `contrast` the step of its logarithm, which the dark
    current reduces in the dark. The pixel is alone, leak and noise are off. Stamps are whole microseconds; half of one
    is added. Nothing is returned where fewer than nine in ten pixels respond.
    """
    p, before = without_readout(_with_noise(p, 0.0)), light * math.exp(-contrast)
    bench = settled(p, before)
    at_us = bench.jump(light)
    bench.hold(round(max(_LEAST_WAIT_S, _LATENCY_WAIT_TAUS * float(lag_s(p, light))) * _S))
    late_us = _first_us(bench, np.ones(bench.light.shape, bool)) - at_us + 0.5
    if late_us.size < _MOST_PIXELS * bench.light.size:
        return []
    middle, low, high = (float(np.percentile(late_us, share)) for share in (50, 5, 95))
    seen = float(log_current(p, light) - log_current(p, before))
    share = _share(p, seen)
    model_us = 1e6 * _rise_s(p, light, share) + p.jitter.latency_us
    name = f"step of {contrast:.2g} ln"
    corners = [_corner_hz(share, us - p.jitter.latency_us) for us in (middle, high, low, model_us)]
    return [
        Point("latency", name, light, middle, low, high, model_us),
        Point("bandwidth", name, light, *corners),
    ]


def _share(p: SensorParameters, step: float) -> float:
    """Return the share of a step of log light that the low-pass has covered when the output reaches the threshold.

    The large-signal photoreceptor filters the inverse of the current, e^-v, by the same pole.
    """
    if p.photoreceptor == "large_signal" and not p.source_follower_hz:
        return math.expm1(-p.threshold_on) / math.expm1(-step)
    return p.threshold_on / step


def _corner_hz(share: float, rise_us: float) -> float:
    """Return the corner frequency of a single pole that covers a share of a step in that time."""
    if share >= 1 or rise_us <= 0:
        return math.nan
    return -math.log1p(-share) / (2 * math.pi * rise_us * 1e-6)


def _rise_s(p: SensorParameters, light: float, share: float) -> float:
    """Return the time in which the filter covers a share of a step, by bisection; NaN: never, or no closed form.

    A second pole behind a photoreceptor with large signals has no closed form.
    """
    first, second = float(lags_s(p, light)[0]), lags_s(p, light)[1]
    if share >= 1 or (p.photoreceptor != "one_pole" and second > 0):
        return math.nan
    low, high = 0.0, (first + second) * (1 - math.log1p(-share)) * 4
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if _risen(middle, first, second) < share else (low, middle)
    return high


def _risen(t_s: float, first_s: float, second_s: float) -> float:
    """Return the share of a step that two poles have covered after a time; equal poles are shifted slightly apart."""
    if second_s == 0 or first_s == 0:
        one = max(first_s, second_s)
        return -math.expm1(-t_s / one) if one else 1.0
    if math.isclose(first_s, second_s, rel_tol=1e-6):
        second_s *= 1 + 1e-5
    rest = first_s * math.exp(-t_s / first_s) - second_s * math.exp(-t_s / second_s)
    return 1 - rest / (first_s - second_s)


def _first_us(bench: Bench, lit: Mask) -> Floats:
    """Finish, and return the time of the first ON event of each lit pixel, us, pixels without one left out."""
    events = bench.finish()
    events = events[events["on"] & lit[events["y"], events["x"]]]
    _, first = np.unique(bench.pixel(events), return_index=True)
    return np.asarray(events["t"][first], np.float64)


def burst(p: SensorParameters, pixels: int, size: tuple[int, int]) -> list[Point]:
    """Return the read-out time of pixels that fire together: from first event to last pixel, us."""
    bench = settled(on_the_bench(_with_noise(p, 0.0), size), 1.0)
    width, height = size
    lit = np.zeros((height, width), bool)
    lit.flat[np.linspace(0, lit.size - 1, pixels).round().astype(int)] = True
    bench.jump(np.where(lit, bench.light * math.exp(_FLASH), bench.light))
    bench.hold(_S // 10, steps=10)
    t_us = _first_us(bench, lit)
    model = pixels * p.readout.event_ns * 1e-3
    return [Point("burst", f"{width} x {height}", pixels, float(t_us.max() - t_us.min()), model=model)]


def flicker(p: SensorParameters, curve: str, series: str, hz: float, light: float) -> list[Point]:
    """Return the event rate of a pixel under a triangular flicker of 10:1 about a light, at a constant log rate.

    The model is the rate of events on an endless ramp of that rate, 1 / (dead time + threshold / contrast rate), which
    is an upper bound.
    """
    p = _with_noise(p, 0.0)
    middle = log_current(p, light)
    bench = Bench(p, np.exp(middle) - np.exp(log_current(p, 0)))
    part_ns = max(1, round(_S / hz / (2 * _PARTS)))
    heights = np.interp(np.arange(1, 2 * _PARTS + 1) / (2 * _PARTS), [0, 0.25, 0.75, 1], [0, 1, -1, 0])
    settle = 2 + math.ceil(_SETTLE_TAUS * float(lag_s(p, light)) * hz)
    counted = max(_COUNTED, math.ceil(_COUNTED_DEAD_TIMES * p.refractory_us * 1e-6 * hz))
    for k in range(settle + counted):
        if k == settle:
            bench.sent()
        for height in heights:
            bench.ramp(np.exp(middle + height * _FLICKER / 2) - np.exp(log_current(p, 0)), part_ns)
    counted_s = counted * 2 * _PARTS * part_ns * 1e-9
    rate_hz = bench.sent().size / bench.light.size / counted_s
    contrast_rate = 2 * _FLICKER * hz
    mean_threshold = (p.threshold_on + p.threshold_off) / 2
    most_hz = 1 / (p.refractory_us * 1e-6 + mean_threshold / contrast_rate)
    if curve == "flicker_events":
        return [Point(curve, series, hz, rate_hz / hz, model=most_hz / hz)]
    return [Point(curve, series, hz, rate_hz, model=most_hz)]


Measurement = Callable[[], list[Point]]

CONFIGURED = "as configured"
"""Name of the series with the sensor's own parameters."""

_EXAMPLE = "example: parasitic leak that light 1 makes as large"
_MISMATCHES = {"mismatch 2.1 %": 0.021, "mismatch 10 %": 0.1}
_RMS = (0.043, 0.073)
_CONTRASTS = (0.4, 0.7, 1.5)
_DEAD_US = (100.0, 500.0)
_MOST_CORNERS = 30  # corner frequencies: a faster flicker gives no events


@dataclasses.dataclass(frozen=True)
class _Sweep:
    """Resolutions of the sweeps."""

    deviations: int
    celsius: Sequence[float]
    lights: int
    leak_s: float
    noise_s: float
    flicker: int
    burst: Sequence[int]


_QUICK = _Sweep(7, (0, 20, 40), 6, 20.0, 4.0, 8, (100, 1000, 10_000))
_FULL = _Sweep(
    19, (-20, -10, 0, 10, 20, 30, 40, 50, 60), 16, 60.0, 20.0, 24,
    (10, 100, 1000, 3000, 10_000, 30_000, 100_000, 300_000, 900_000),
)  # fmt: skip


def measurements(p: SensorParameters, quick: bool) -> list[Measurement]:
    """Return the measurements of a sensor, each as a function."""
    sweep, small, still = _QUICK if quick else _FULL, on_the_bench(p), _silent(p)
    alone = on_the_bench(still)
    return [
        *_threshold_measurements(alone, sweep),
        *_leak(alone, sweep),
        *_noise(small, sweep),
        *_timing(alone, still, sweep),
    ]


def _silent(p: SensorParameters) -> SensorParameters:
    """Return the sensor without noise and background, which would hide thresholds, leak and times."""
    return dataclasses.replace(p, noise=dataclasses.replace(p.noise, rms=0.0), background=BackgroundParameters())


def _threshold_measurements(p: SensorParameters, sweep: _Sweep) -> Iterator[Measurement]:
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
        return  # the bandwidth of the noise is not limited
    swept = {CONFIGURED: p.noise.rms} if p.noise.rms else {f"noise {rms:g} rms": rms for rms in _RMS}
    for series, deviation in swept.items():
        yield partial(_figure, "noise swept, ln rms", deviation)
        for light in np.geomspace(1e-4, 10, sweep.lights):
            yield partial(noise_light, p, series, deviation, float(light), sweep.noise_s)


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
        for series, light in (("1 klux", 1.0), ("10 lux", 1e-2), ("0.1 lux", 1e-4)):
            if hz < _MOST_CORNERS * corner_hz(at_temperature(p), light):
                yield partial(flicker, alone, "flicker_events", series, float(hz), light)
        for dead_us in dict.fromkeys((p.refractory_us, *_DEAD_US)):
            one = dataclasses.replace(alone, refractory_us=dead_us)
            yield partial(flicker, one, "flicker_rate", f"dead time {dead_us:g} us", float(hz), 1.0)


def figures(points: Sequence[Point]) -> list[Point]:
    """Return the single values that follow from the curves: the leak's doubling and the read-out's speed."""
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
