"""Noise, latency, dead time: what happens when, and how often.

Each function measures one point or one line with a fresh `Bench`, and says what the equations give for it.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from emulator.characterise.points import Point
from emulator.characterise.stimuli import Bench, lag_s, lags_s, log_current, on_the_bench, settled, without_readout
from emulator.sensor.chip.temperature import at_temperature
from emulator.sensor.noise.law import bandwidth_hz, corner_hz, of_array, rms
from emulator.sensor.presets import SensorParameters

__all__ = ["burst", "flicker", "latency", "noise_law", "noise_light"]

_Floats = npt.NDArray[np.float64]

_S = 1_000_000_000
_WAIT_TAUS = 15
_MOST_PIXELS = 0.9
_LEAST_WAIT_S = 1e-3
_NOISE_STEP_S = 0.1
_NODES = 9
_FLICKER = math.log(10)
_PARTS = 8  # of half a period
_SETTLE_TAUS = 8
_COUNTED = 4  # periods at least
_COUNTED_DEAD_TIMES = 20  # so that the one at the edge does not count
_FLASH = 3.0  # ln: over every threshold


def noise_light(p: SensorParameters, series: str, noise_rms: float, light: float, for_s: float) -> list[Point]:
    """Return how often a pixel fires by temporal noise alone, ON and OFF, in still light."""
    p = _with_noise(p, noise_rms)
    model = sum(_law_hz(p, light))
    return [Point("noise_light", series, light, sum(_noise_hz(p, light, for_s)), model=model)]


def noise_law(p: SensorParameters, series: str, a: float, light: float, for_s: float) -> list[Point]:
    """Return the ON rate over the noise's bandwidth where the threshold is `a` times the noise."""
    quiet = float(rms(_with_noise(p, 1.0), corner_hz(at_temperature(p), light)))
    p = _with_noise(p, (p.threshold_on + p.threshold_off) / 2 / (a * quiet))
    bandwidth = float(bandwidth_hz(p, corner_hz(at_temperature(p), light)))
    on_hz, _ = _noise_hz(p, light, for_s)
    return [Point("noise_law", series, a, on_hz / bandwidth, model=_law_hz(p, light)[0] / bandwidth)]


def _with_noise(p: SensorParameters, noise_rms: float) -> SensorParameters:
    """Return the sensor with that noise and no leak, so that all it sends in still light is noise."""
    noise = dataclasses.replace(p.noise, rms=noise_rms)
    return dataclasses.replace(p, noise=noise, leak_hz=0.0, parasitic_hz_at_reference=0.0)


def _law_hz(p: SensorParameters, light: float) -> tuple[float, float]:
    """Return the ON and the OFF rate of the law, averaged over pixels whose mean thresholds spread normally."""
    node, weight = np.polynomial.hermite_e.hermegauss(_NODES)
    deviation = p.mismatch * math.hypot(p.threshold_on, p.threshold_off) / 2
    thresholds = (p.threshold_on + p.threshold_off) / 2 + deviation * node
    law = of_array(p, thresholds, corner_hz(at_temperature(p), light))
    return tuple(float(np.sum(weight * rate) / np.sum(weight)) for rate in (law.on, law.off))  # type: ignore[return-value]


def _noise_hz(p: SensorParameters, light: float, for_s: float) -> tuple[float, float]:
    """Return the ON and the OFF rate of a pixel in still light."""
    bench = Bench(without_readout(p), light)
    bench.hold(round(for_s * _S), steps=math.ceil(for_s / _NOISE_STEP_S))
    on = bench.finish()["on"]
    each_s = for_s * bench.light.size
    return float(np.count_nonzero(on)) / each_s, float(np.count_nonzero(~on)) / each_s


def latency(p: SensorParameters, contrast: float, light: float) -> list[Point]:
    """Return how long after a step up to a light a pixel's first event comes, and the bandwidth that this tells.

    `light` is that after the step, which the filter's speed follows; `contrast` the step of its logarithm, of which the
    dark current leaves less in the dark. The pixel is alone, leak and noise are off. Stamps are whole microseconds;
    half of one is added. Nothing is returned where fewer than nine in ten pixels answer.
    """
    p, before = without_readout(_with_noise(p, 0.0)), light * math.exp(-contrast)
    bench = settled(p, before)
    at_us = bench.jump(light)
    bench.hold(round(max(_LEAST_WAIT_S, _WAIT_TAUS * float(lag_s(p, light))) * _S))
    late_us = _first_us(bench, np.ones(bench.light.shape, bool)) - at_us + 0.5
    if late_us.size < _MOST_PIXELS * bench.light.size:
        return []
    middle, low, high = (float(np.percentile(late_us, share)) for share in (50, 5, 95))
    seen = float(log_current(p, light) - log_current(p, before))
    share = p.threshold_on / seen
    model_us = 1e6 * _rise_s(p, light, share) + p.jitter.latency_us
    name = f"step of {contrast:.2g} ln"
    corners = [_corner_hz(share, us - p.jitter.latency_us) for us in (middle, high, low, model_us)]
    return [
        Point("latency", name, light, middle, low, high, model_us),
        Point("bandwidth", name, light, *corners),
    ]


def _corner_hz(share: float, rise_us: float) -> float:
    """Return the corner frequency of a single pole that goes a share of a step in that time."""
    if share >= 1 or rise_us <= 0:
        return math.nan
    return -math.log1p(-share) / (2 * math.pi * rise_us * 1e-6)


def _rise_s(p: SensorParameters, light: float, share: float) -> float:
    """Return how long the filter takes to go a share of a step, by bisection; NaN: it never does."""
    first, second = float(lags_s(p, light)[0]), lags_s(p, light)[1]
    if share >= 1:
        return math.nan
    low, high = 0.0, (first + second) * (1 - math.log1p(-share)) * 4
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if _risen(middle, first, second) < share else (low, middle)
    return high


def _risen(t_s: float, first_s: float, second_s: float) -> float:
    """Return how much of a step two poles have gone after a time; equal ones are taken a little apart."""
    if second_s == 0 or first_s == 0:
        one = max(first_s, second_s)
        return -math.expm1(-t_s / one) if one else 1.0
    if math.isclose(first_s, second_s, rel_tol=1e-6):
        second_s *= 1 + 1e-5
    rest = first_s * math.exp(-t_s / first_s) - second_s * math.exp(-t_s / second_s)
    return 1 - rest / (first_s - second_s)


def _first_us(bench: Bench, lit: npt.NDArray[np.bool_]) -> _Floats:
    """Finish, and return the time of the first ON event of each lit pixel, us, pixels without one left out."""
    events = bench.finish()
    events = events[events["on"] & lit[events["y"], events["x"]]]
    _, first = np.unique(bench.pixel(events), return_index=True)
    return np.asarray(events["t"][first], np.float64)


def burst(p: SensorParameters, pixels: int, size: tuple[int, int]) -> list[Point]:
    """Return how long the read-out takes for pixels that fire together: from first event to last pixel, us."""
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
    """Return the events a pixel sends under a triangular flicker of 10:1 about a light, its logarithm's rate constant.

    The model is the rate of events on an endless ramp of that rate, 1 / (dead time + threshold / contrast rate): more
    than that cannot be.
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
