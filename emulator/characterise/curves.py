"""Thresholds and leak: S-curves, the spread between pixels, leak against temperature and light.

Each function measures one point or one line with a fresh `Bench`, and says what the equations give for it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from emulator.characterise.points import FIGURE, Point
from emulator.characterise.stimuli import Bench, lag_s, log_current, settled, without_readout
from emulator.sensor.chip.temperature import at_temperature
from emulator.sensor.presets import SensorParameters

__all__ = ["leak_light", "leak_spread", "leak_temperature", "s_curve", "spread"]

_Floats = npt.NDArray[np.float64]

_S = 1_000_000_000
_WAIT_TAUS = 20
_LEAST_WAIT_S = 1e-3
_RAMP_SPAN = 4.0  # ln
_RAMP_RATE = 100.0  # ln a second: leak is nothing against it
_BRIGHT = 2.0  # lowest light of that ramp: the filter is at its fastest
_BINS = 41


def s_curve(p: SensorParameters, series: str, mismatch: float, deviations: _Floats, light: float = 1.0) -> list[Point]:
    """Return the share of pixels that answer a contrast step, ON and OFF, at steps some deviations off the threshold.

    The model is the normal distribution of the thresholds.
    """
    p = dataclasses.replace(p, mismatch=mismatch)
    points = []
    for curve, threshold, sign in (("s_curve_on", p.threshold_on, 1), ("s_curve_off", p.threshold_off, -1)):
        for deviation in deviations:
            contrast = threshold * (1 + mismatch * deviation)
            share = _answering(p, sign * contrast, light)
            points.append(Point(curve, series, contrast, share, model=_normal(deviation)))
    return points


def _answering(p: SensorParameters, contrast: float, light: float) -> float:
    """Return the share of the pixels that send an event of the step's sign, one or more."""
    bench = settled(without_readout(p), light)
    after = np.exp(log_current(p, bench.light) + contrast) - np.exp(log_current(p, 0))
    bench.jump(after)
    bench.hold(round(max(_LEAST_WAIT_S, _WAIT_TAUS * float(lag_s(p, after).max())) * _S))
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


def _thresholds(p: SensorParameters, on: bool) -> _Floats:
    """Return each pixel's threshold: contrast rate times the median gap, dead time taken off, ln."""
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


def _times_us(bench: Bench, events: npt.NDArray[np.void]) -> list[npt.NDArray[np.int64]]:
    """Return the times of each pixel's events, pixel by pixel, us."""
    pixel = bench.pixel(events)
    order = np.argsort(pixel, kind="stable")
    cuts = np.flatnonzero(np.diff(pixel[order])) + 1
    return np.split(events["t"][order].astype(np.int64), cuts)


def _histogram(curve: str, series: str, values: _Floats, edges: _Floats, below: Sequence[float]) -> list[Point]:
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
    t = p.temperature
    model = p.leak_hz * 2 ** ((celsius - t.reference_celsius) / t.leak_doubles_every_k)
    model += p.parasitic_hz_at_reference * float(np.exp(log_current(warm, 0)))
    return [Point("leak_temperature", series, celsius, *_leak_hz(warm, 0.0, for_s), model)]


def leak_light(p: SensorParameters, series: str, light: float, for_s: float) -> list[Point]:
    """Return the rate of leak events of a pixel in a light."""
    t = p.temperature
    model = p.leak_hz * 2 ** ((t.celsius - t.reference_celsius) / t.leak_doubles_every_k)
    model += p.parasitic_hz_at_reference * float(np.exp(log_current(p, light)))
    return [Point("leak_light", series, light, *_leak_hz(p, light, for_s), model)]


def _leak_hz(p: SensorParameters, light: float, for_s: float) -> tuple[float, float, float]:
    """Return the mean rate of events in still light without temporal noise, and 5 % and 95 % of the pixels' rates."""
    bench = Bench(without_readout(_noiseless(p)), light)
    bench.hold(round(for_s * _S), steps=math.ceil(for_s))
    counts = np.bincount(bench.pixel(bench.finish()), minlength=bench.light.size) / for_s
    return float(counts.mean()), float(np.percentile(counts, 5)), float(np.percentile(counts, 95))


def leak_spread(p: SensorParameters, for_s: float) -> list[Point]:
    """Return how the pixels' leak rates spread, by the gaps between their events; log-normal is the model.

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
