"""Noise of a sensor's comparators by its parameters: rms and poles in a light, and rates of events in still light.

    sigma^2 = rms^2 corner / (corner + f)       f: of the photoreceptor, in proportion to the photocurrent, Hz
                                                corner: of the fixed pole behind it

so noise events are rare in bright light, and in the dark, where f is low. A sensor without a low-pass (infinite f) has
the fixed pole alone, and one without a fixed pole the receptor's: sigma = rms for both.

Rates in still light follow from a Markov chain of a pixel's references: it stays at one for an exponential time, while
leak moves it towards the ON threshold, and the next one is the noise at the end of the dead time. They are for plans
and bounds; the events themselves follow from the hazard of each pixel at each instant.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.noise.hazard import ONE_POLE, integral_tables, pair_factors, rate_of, slice_of
from emulator.sensor.noise.moments import Noise, moments_over, noise_in, slower_rate
from emulator.sensor.numerics.columns import Packed
from emulator.sensor.numerics.compiled import cached_entry, kernel, kernel_that_allocates
from emulator.sensor.presets import SensorParameters

_Floats = npt.NDArray[np.float64]
_Float32s = npt.NDArray[np.float32]

_LEVELS, _BLUR = 72, 0.5  # of a grid of references: places; steps
_FINE = 9.0  # deviations from each end in which the grid is fine
_STAGES, _SINGLE = np.int64(16), np.int64(1)  # of the time before the start, and of an endless one
_AT_ONCE = 1e-6  # thresholds of references at one phase
SHARES_A_LOGIT, LAST_LOGIT = 4, 14
SHARES = 1 / (1 + np.exp(-np.arange(-LAST_LOGIT, LAST_LOGIT + 0.1, 1 / SHARES_A_LOGIT)))
"""Shares of the quantiles of references at the start, uniform in their logits."""

_NODES = 5, 8  # of the sums and differences of a pixel's two thresholds; with an even number none are equal
_FASTEST_HZ = 1e12
_F0, _F1 = np.float32(0), np.float32(1)
_NEEDED = np.bool_(True)
_ENDLESS_HZ = 1e-25


class Rates(NamedTuple):
    """Rates of ON and OFF events of a pixel, Hz."""

    on: float
    off: float


def corner_hz(p: SensorParameters, light: npt.ArrayLike) -> _Floats:
    """Return the photoreceptor's corner frequency f, Hz, at a light; infinite where the sensor has no low-pass."""
    current = np.maximum(np.asarray(light, np.float64), 0) + p.dark_current_relative
    if math.isinf(p.corner_hz_at_reference):
        return np.full_like(current, np.inf)
    return np.clip(p.corner_hz_at_reference * current, p.corner_min_hz, p.corner_max_hz)


def fixed_corner_hz(p: SensorParameters) -> float:
    """Return the fixed pole of the noise, Hz: its own, or the signal's source follower; infinite: none."""
    return p.noise.corner_hz or p.source_follower_hz or math.inf


def rms(p: SensorParameters, f_hz: npt.ArrayLike) -> _Floats:
    """Return sigma, ln units, where the photoreceptor's corner frequency is `f_hz`."""
    f, corner = np.asarray(f_hz, np.float64), fixed_corner_hz(p)
    passed = np.where(np.isinf(f) | math.isinf(corner), 1.0, 1 / (1 + np.minimum(f, 1e300) / corner))
    return np.asarray(p.noise.rms * np.sqrt(passed))


class _Chain(NamedTuple):
    """Chain of a pixel's references, less the signal, on a grid: rates of its events and of its changes, Hz."""

    edges: _Floats  # of the cells, (levels + 1,), ln units
    on: _Floats  # (levels,)
    off: _Floats
    rates: _Floats  # from the first to the second, (levels, levels)


@kernel
def _middle(edges: _Floats, i: int) -> float:
    """Return the reference in the middle of a cell."""
    return float((edges[i + 1] + edges[i]) / 2)


@kernel
def _weigh(edges: _Floats, reset: float, spread: float, weights: _Floats) -> float:
    """Write the weights of the cells, (levels,), for resets spread around a reference; return their sum."""
    first, total = edges[1] - edges[0], 0.0
    for j in range(_LEVELS):
        step = edges[j + 1] - edges[j]
        begin = _middle(edges, j) + (step - first) / 2  # of a stay in a coarse cell, which leak crosses as a whole
        width = max(spread, _BLUR * step)
        away = (begin - reset) / width
        weights[j] = math.exp(-0.5 * (away * away)) * step / width
        total += weights[j]
    return total


@kernel_that_allocates
def _chain(on: float, off: float, leak: float, noise: Noise, dead_s: float, tables: Packed) -> _Chain:
    """Return the chain of a pixel with thresholds on and off, and a leak in ln units a second.

    The grid reaches a deviation beyond the thresholds, as a reset may. It is fine where noise reaches a threshold.
    """
    beyond, span = on + noise.sigma, on + off + 2 * noise.sigma
    fine = min(span / 2, _FINE * noise.sigma)
    share = fine / (2 * fine + min(span - 2 * fine, fine))  # of the cells, at each end
    slope = (span / 2 - fine) / max(0.5 - share, 1e-9)
    edges = np.empty(_LEVELS + 1)
    for i in range(_LEVELS + 1):
        x = abs(i / _LEVELS - 0.5)
        half = x * slope if x < 0.5 - share else span / 2 - (0.5 - x) * fine / share
        edges[i] = math.copysign(half, i / _LEVELS - 0.5) + span / 2 - beyond
    kept, pushed = math.exp(-noise.rate * dead_s), 0.0
    lost = 1 - kept * kept
    if noise.z < ONE_POLE and dead_s > 0:
        m = moments_over(np.float32(dead_s), noise)
        slope = m.b12  # at a passage it is distributed as Rayleigh's
        kept, pushed = m.p11, math.sqrt(math.pi / 2) * noise.sigma * slope
        lost = m.v + (2 - math.pi / 2) * slope**2
    rates, weights = np.zeros((_LEVELS, _LEVELS)), np.empty(_LEVELS)
    on_hz, off_hz = np.empty(_LEVELS), np.empty(_LEVELS)
    slow, k = slower_rate(noise), slice_of(noise.z)
    lowest, highest = _middle(edges, 0), _middle(edges, _LEVELS - 1)
    for i in range(_LEVELS):
        level = _middle(edges, i)
        c_on, c_off = np.float32((on + level) / noise.sigma), np.float32((off - level) / noise.sigma)
        on_factor, off_factor = pair_factors(tables, c_on, c_off, noise.z, _F1, _NEEDED)
        h_on = np.float64(noise.rate * rate_of(tables, k, noise.apart, c_on, _F0, _NEEDED) * on_factor)
        h_off = np.float64(noise.rate * rate_of(tables, k, noise.apart, c_off, _F0, _NEEDED) * off_factor)
        # The noise is at the reference at first, and comes near a threshold when it has decayed.
        decays = math.log(1 + max(min(c_on, c_off), 0.0) * abs(level) / noise.sigma)
        staying = 1 / (1 + (h_on + h_off) * (dead_s + decays / slow))
        h_on, h_off = h_on * staying, h_off * staying
        is_last = _middle(edges, max(i - 1, 0)) <= -on < level  # from there leak comes to the threshold
        leaving = leak / (on + level if is_last else edges[i + 1] - edges[i])
        ended = leaving if is_last else 0.0
        up, down = (level + on) * kept + pushed, (level - off) * kept - pushed
        for hz, reset in ((h_on, up), (h_off, down), (ended, 0.0)):
            if hz > 0:
                total = _weigh(edges, min(max(reset, lowest), highest), math.sqrt(lost) * noise.sigma, weights)
                for j in range(_LEVELS):
                    rates[i, j] += hz / total * weights[j]
        on_hz[i], off_hz[i] = h_on + ended, h_off
        rates[i, max(i - 1, 0)] += leaving - ended
    return _Chain(edges, on_hz, off_hz, rates)


@kernel_that_allocates
def _pass(rates: _Floats, stages: int, stage_hz: float, shares: _Floats) -> None:
    """Change the shares of a chain's references, (levels,), to those after some stages, each exponential in time.

    References are eliminated one by one, without a subtraction (Grassmann, Taksar and Heyman 1985), because the rates
    at which they are left differ by many orders of magnitude. `rates` is used up.
    """
    left, ends = np.empty(_LEVELS), np.full(_LEVELS, stage_hz)
    for i in range(_LEVELS - 1, -1, -1):
        leaving = 0.0
        for j in range(i):
            leaving += rates[i, j]
        left[i] = leaving + ends[i]
        for j in range(i):
            rates[j, i] /= left[i]
            ends[j] += rates[j, i] * ends[i]
            for k in range(i):
                rates[j, k] += rates[j, i] * rates[i, k]
    for _ in range(stages):
        for i in range(_LEVELS - 1, -1, -1):
            shares[i] /= left[i]
            for k in range(i):
                shares[k] += shares[i] * rates[i, k]
        for i in range(_LEVELS):
            for k in range(i + 1, _LEVELS):
                shares[k] += shares[i] * rates[i, k]
            shares[i] *= stage_hz


@cached_entry
def _rates(  # noqa: PLR0913, PLR0917
    on: float, off: float, leak_hz: float, rate: float, pole: float, rms: float, high: float, dead_s: float,
    tables: Packed,
) -> tuple[float, float]:  # fmt: skip
    """Return the `Rates` of a pixel with thresholds on and off, from the shares of time that its references have."""
    noise = noise_in(np.float32(rate), np.float32(pole), np.float32(rms), np.float32(high))
    chain = _chain(on, off, leak_hz * on, noise, dead_s, tables)
    shares = np.full(_LEVELS, 1 / _LEVELS)
    _pass(chain.rates, _SINGLE, _ENDLESS_HZ, shares)
    on_hz = off_hz = 0.0
    for k in range(_LEVELS):
        on_hz += shares[k] * chain.on[k]
        off_hz += shares[k] * chain.off[k]
    return on_hz, off_hz


class Before(NamedTuple):
    """Time before the start of a stream, in which noise has moved the references."""

    history_s: float
    phases: float  # share of the ON threshold below the signal in which they lay at first
    dead_s: float
    pole: float  # rate of the fixed pole, 1/s; 0: none
    high: float  # of the high-pass, 1/s; 0: none


@cached_entry
def solve_start(  # noqa: PLR0913, PLR0917
    on: float, off: float, rate: float, turns: float, before: Before, tables: Packed, quantiles: _Float32s
) -> None:  # fmt: skip
    """Write the quantiles, (SHARES.size,), of a pixel's reference less its signal at the start, in units of the rms.

    `on` and `off` are thresholds in these units, `turns` the thresholds that leak passes before the start. The time is
    one of _STAGES exponential ones, for which one elimination serves; the mean of 1 / time, which the rates of a chain
    that has not settled follow, is that of `history_s`.
    """
    noise = noise_in(np.float32(rate), np.float32(before.pole), _F1, np.float32(before.high))
    chain = _chain(on, off, turns * on / before.history_s, noise, before.dead_s, tables)
    lowest = max(chain.edges[0], -on * max(before.phases, _AT_ONCE))
    shares = np.empty(_LEVELS)
    for k in range(_LEVELS):
        from_, to = max(chain.edges[k], lowest), max(chain.edges[k + 1], lowest)
        shares[k] = (min(to, 0.0) - min(from_, 0.0)) / -lowest
    _pass(chain.rates, _STAGES, (_STAGES - 1) / before.history_s, shares)
    below, i = 0.0, 0
    for k, share in enumerate(SHARES):
        while i < _LEVELS - 1 and below + shares[i] < share:
            below += shares[i]
            i += 1
        inside = min((share - below) / max(shares[i], 1e-300), 1.0)
        quantiles[k] = chain.edges[i] + (chain.edges[i + 1] - chain.edges[i]) * inside


def still_hz(p: SensorParameters, f_hz: float) -> Rates:
    """Return the rates of a pixel's events by noise and leak in still light, averaged over mismatch of its thresholds.

    `f_hz` is the photoreceptor's corner frequency. The parasitic leak is left out. Rates are those after a long time;
    beyond 3 deviations without leak or mismatch they are too low, because noise is taken to have forgotten its reset.
    """
    if not p.noise.rms:
        return Rates(p.leak_hz, 0.0)
    rate, pole = 2 * math.pi * min(float(f_hz), _FASTEST_HZ), 2 * math.pi * fixed_corner_hz(p)
    noise = rate, 0.0 if math.isinf(pole) else pole, p.noise.rms, 2 * math.pi * p.highpass_hz
    (sums, w0), (differences, w1) = (np.polynomial.hermite_e.hermegauss(n) for n in _NODES)
    spread, dead_s = p.mismatch * math.sqrt(0.5), p.refractory_us * 1e-6
    on = p.threshold_on * np.maximum(1 + spread * np.add.outer(sums, differences), 0.1).reshape(-1)
    off = p.threshold_off * np.maximum(1 + spread * np.subtract.outer(sums, differences), 0.1).reshape(-1)
    rates = [_rates(x, y, p.leak_hz, *noise, dead_s, integral_tables()) for x, y in zip(on, off, strict=True)]
    return Rates(*np.average(rates, axis=0, weights=np.outer(w0, w1).reshape(-1)).tolist())
