"""Rate of the events that temporal noise alone raises in still light: the exact law of first passages, and its table.

The noise is a voltage n of rms sigma with one pole at f_n (an Ornstein-Uhlenbeck process). An event needs a first
passage from the level that the last event left to a threshold away from it. The rate of these passages, over f_n,
depends on the thresholds over sigma and on the refractory period over tau = 1 / (2 pi f_n), at whose end the level is
set again, usually on a peak of the noise. A run interpolates a table, over

    a            mean of the two thresholds over sigma: log(rate / (a e^(-a^2 / 2))) is linear in a^2, also beyond
    difference   (ON - OFF) over the mean
    refractory   refractory period over tau, in its square root, which is proportional to the distance of a diffusion

The difference matters: with equal thresholds and a short refractory period the levels come to lie midway between two
passages, and stay there, firing ON and OFF in turns; with thresholds that differ by some percent each pair of events
moves them on. ON rate over f_n:

    a      refractory period .03 tau, difference     1 tau
           0       .02     .05     .1                0
    3      .293    .284    .267    .252              .167
    4      .0452   .0344   .0262   .0233             .0140
    5      .0027   .0010   .0006   .0006             .0004

In the long run the levels stay near the noise's mean, so ON and OFF events come in the inverse ratio of the thresholds
where the refractory period is short. Leak moves the levels too, which the law leaves out: at a = 4 and f_n = 150 Hz,
0.1 Hz of leak raises the rate by two thirds without a refractory period, by a tenth with one of tau (pixels of `grid`).

How sigma and f_n follow the light: a photoreceptor whose corner frequency f is proportional to its current has shot
noise of constant rms. A fixed pole `corner` behind it, the signal's source follower, takes the fast part away:

    sigma^2 = rms^2 corner / (corner + f),    f_n = f corner / (corner + f)

so noise events are rare in bright light, and in the dark, where f is low. A sensor without a low-pass (infinite f) has
the fixed pole alone: sigma = rms, f_n = corner. One without a fixed pole has sigma = rms, f_n = f.

The table is made from the exact law of first passages. The noise is an Ornstein-Uhlenbeck process x, here in units of
its deviation sigma and its time constant tau. A pixel whose reference was set at the level c fires when x, which starts
at c, first leaves (c - off, c + on). It is then refractory for the time rho, and its reference is set at c' = x at its
end, which is normal:

    c' = (c + on) e^-rho + sqrt(1 - e^(-2 rho)) N     after an ON event; after an OFF event c - off in place of c + on

So the levels are a Markov chain. With S(x) the integral of e^(y^2 / 2), and M(y) that of e^(-z^2 / 2) from the lower
end, the side of the exit and its mean time are

    P(ON | c) = (S(c) - S(low)) / (S(high) - S(low))
    T(c)      = P(ON | c) int_low^high S' M dy - int_low^c S' M dy

The rate follows from the chain's stationary density pi: 1 / sum pi (T + rho). The exit time is near to exponential, so
its square has the mean 2 sum pi T^2.

`python -m emulator.sensor.noise.law` writes the table, some ten minutes.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.keyed import Purpose, normal
from emulator.sensor.presets import SensorParameters

_Floats = npt.NDArray[np.float64]

A = np.array([1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 6.0, 7.0])
"""Mean threshold over sigma, of the table."""

DIFFERENCE = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8])
"""Difference of the higher and the lower threshold over their mean, of the table."""

REFRACTORY = np.array([0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
"""Refractory period over tau, of the table."""

TABLE = Path(__file__).with_name("data") / "first_passage.npy"
"""(A, DIFFERENCE, REFRACTORY, 4) float32: the fields of `Statistics` where the ON threshold is the higher one."""

_BEYOND = 4.0  # deviations by which levels may lie beyond a threshold
_INTERVALS = 160  # of a quadrature
_COARSEST, _PER_DEVIATION = 0.1, 3.0  # levels: their largest distance, and how many to a deviation of the re-reading


class Statistics(NamedTuple):
    """Noise events of a pixel in still light, without leak.

    Attributes
    ----------
    on, off : rates over the noise's bandwidth f_n = 1 / (2 pi tau).
    opposite : share of the events whose next one has the other polarity.
    gap : mean time from event to event within a burst, tau, when intervals are taken as two exponentials, short ones
        with the share 2 opposite - 1, with the mean and the variance of all.
    """

    on: float
    off: float
    opposite: float
    gap: float


def _odd_integral(x: _Floats) -> _Floats:
    """Return the integral of e^(y^2 / 2) from 0 to x."""
    from scipy.special import erfi  # loaded where it is used: it takes longer than the rest of a short run's imports

    return np.asarray(np.sqrt(np.pi / 2) * erfi(x / np.sqrt(2)))


def _quadrature(begin: _Floats, end: _Floats, low: _Floats) -> _Floats:
    """Return the integrals of e^(y^2 / 2) int_low^y e^(-z^2 / 2) dz from `begin` to `end`, by Simpson's rule."""
    from scipy.special import ndtr

    share = np.linspace(0, 1, _INTERVALS + 1)
    weight = np.ones(_INTERVALS + 1)
    weight[1:-1:2], weight[2:-1:2] = 4, 2
    y = begin[:, None] + (end - begin)[:, None] * share
    inner = np.sqrt(2 * np.pi) * (ndtr(y) - ndtr(low)[:, None])
    return np.asarray((np.exp(y * y / 2) * inner * weight).sum(1) * (end - begin) / (3 * _INTERVALS))


def exits(c: _Floats, on: float, off: float) -> tuple[_Floats, _Floats]:
    """Return for levels c the probability that the exit is an ON event, and the mean time to it, tau."""
    low, high = c - off, c + on
    below, above = (_odd_integral(c) - _odd_integral(low), _odd_integral(high) - _odd_integral(c))
    p_on = below / (below + above)
    to_c, from_c = _quadrature(low, c, low), _quadrature(c, high, low)
    return p_on, p_on * (to_c + from_c) - to_c


def _levels(on: float, off: float, refractory: float) -> tuple[_Floats, float]:
    deviation = float(np.sqrt(-np.expm1(-2 * refractory)))
    farthest = max(on, off) + _BEYOND
    number = int(2 * farthest / min(_COARSEST, deviation / _PER_DEVIATION)) | 1
    return np.linspace(-farthest, farthest, number), deviation


def statistics(on: float, off: float, refractory: float) -> Statistics:
    """Return the statistics for thresholds of `on` and `off` sigma and a refractory period in tau, above 0."""
    from scipy.special import ndtr

    c, deviation = _levels(on, off, refractory)
    p_on, wait = exits(c, on, off)
    edges = np.concatenate([[-np.inf], (c[1:] + c[:-1]) / 2, [np.inf]])
    decay = np.exp(-refractory)
    after_on, after_off = (
        np.diff(ndtr((edges - (level * decay)[:, None]) / deviation), axis=1) for level in (c + on, c - off)
    )
    chain = p_on[:, None] * after_on + (1 - p_on)[:, None] * after_off
    equations, right = chain.T - np.eye(c.size), np.zeros(c.size)
    equations[-1], right[-1] = 1, 1
    density = np.linalg.solve(equations, right)
    mean = float(density @ wait) + refractory
    opposite = float(density @ (p_on * (after_on @ (1 - p_on)) + (1 - p_on) * (after_off @ p_on)))
    rate, share = 2 * np.pi / mean, float(density @ p_on)
    return Statistics(rate * share, rate * (1 - share), opposite, _gap(density, wait + refractory, opposite))


def _gap(density: _Floats, wait: _Floats, opposite: float) -> float:
    """Return the mean of the short ones of two exponentials, tau; see `Statistics`."""
    short = max(2 * opposite - 1, 1e-3)
    mean = float(density @ wait)
    variance = max(float(density @ wait**2) - mean**2, 0.0)
    return max(mean - float(np.sqrt((1 - short) / short * variance)), 0.0)


def write_table(path: Path = TABLE) -> None:
    """Compute the table and write it."""
    table = np.empty((A.size, DIFFERENCE.size, REFRACTORY.size, 4), np.float32)
    for place in np.ndindex(table.shape[:3]):
        a, difference, refractory = (float(of[k]) for of, k in zip((A, DIFFERENCE, REFRACTORY), place, strict=False))
        table[place] = statistics(a * (1 + difference / 2), a * (1 - difference / 2), refractory)
    np.save(path, table)


if __name__ == "__main__":
    write_table()


_At = tuple[npt.NDArray[np.int64], _Floats]
"""Intervals of some nodes, and the shares in them."""

LEAST_A = float(A[0])
"""Smallest threshold of the law, in sigma; lower ones count as this, because the pixel then fires all the time."""

MOST_UNDER_WAY = 0.5
"""Bursts of a pixel that may be under way at a time, in the mean, for intervals and successors to be those of the law.

A point process lets them overlap, which a pixel cannot; the rates hold all the same.
"""

_LEAST_RATE = 1e-300
_NODES = 7  # of the differences between the two thresholds of the pixels


class NoiseStatistics(NamedTuple):
    """Arrays of the values that `Statistics` has for one pixel."""

    on: _Floats
    off: _Floats
    opposite: _Floats
    gap: _Floats


@functools.cache
def _table() -> tuple[_Floats, _Floats]:
    """Return over (a, difference, refractory, 2): ln(rate / (a e^(-a^2 / 2))), and `opposite` with ln(1 + gap)."""
    values = np.load(TABLE).astype(np.float64)
    tail = (A * np.exp(-(A**2) / 2))[:, None, None, None]
    return np.log(values[..., :2] / tail), np.stack([values[..., 2], np.log1p(values[..., 3])], axis=-1)


def _place(x: _Floats, nodes: _Floats) -> _At:
    """Return the interval of `nodes` that contains x, and the share in it; outside, the outermost interval extended."""
    k = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, nodes.size - 2)
    return k, (x - nodes[k]) / (nodes[k + 1] - nodes[k])


def _interpolated(
    table: _Floats, places: list[_At], depth: int = 0, at: tuple[npt.NDArray[np.int64], ...] = ()
) -> _Floats:
    """Return the table between its nodes, linear in each of the three directions."""
    if depth == len(places):
        return np.asarray(table[at])
    k, share = places[depth]
    low, high = (_interpolated(table, places, depth + 1, (*at, k + side)) for side in (0, 1))
    return low + (high - low) * share[..., None]


def noise_events(a: npt.ArrayLike, difference: npt.ArrayLike, refractory_over_tau: npt.ArrayLike) -> NoiseStatistics:
    """Return the statistics of noise events, arrays; the arguments broadcast.

    Parameters
    ----------
    a : mean of the two thresholds, sigma.
    difference : ON less OFF threshold, over their mean.
    refractory_over_tau : refractory period, tau.
    """
    arguments = (np.asarray(argument, np.float64) for argument in (a, difference, refractory_over_tau))
    mean, apart, refractory = np.broadcast_arrays(*arguments)
    mean, higher_on = np.maximum(mean, LEAST_A), apart >= 0
    apart = np.minimum(abs(apart), DIFFERENCE[-1])
    refractory = np.clip(refractory, REFRACTORY[0], REFRACTORY[-1])
    along = _place(apart, DIFFERENCE), _place(np.sqrt(refractory), np.sqrt(REFRACTORY))
    shapes, chains = _table()
    shape = _interpolated(shapes, [_place(mean**2, A**2), *along])
    rates = np.exp(np.minimum(shape + (np.log(mean) - mean**2 / 2)[..., None], 5.0))
    within = _place(np.minimum(mean, A[-1]), A)
    chain = _interpolated(chains, [within, *along])
    on, off = (np.where(higher_on, rates[..., k], rates[..., 1 - k]) for k in (0, 1))
    return NoiseStatistics(on, off, np.clip(chain[..., 0], 0, 1), np.maximum(np.expm1(chain[..., 1]), 0))


def of_array(p: SensorParameters, thresholds: npt.ArrayLike, f_hz: npt.ArrayLike) -> NoiseStatistics:
    """Return the statistics of a sensor's pixels, averaged over the differences between their two thresholds.

    Parameters
    ----------
    thresholds : mean of a pixel's two thresholds, ln units.
    f_hz : corner frequency of the photoreceptor, Hz; broadcasts with `thresholds`.

    Returns
    -------
    on, off in Hz; opposite; gap in s.
    """
    bandwidth, mean = bandwidth_hz(p, f_hz), (p.threshold_on + p.threshold_off) / 2
    node, weight = np.polynomial.hermite_e.hermegauss(_NODES)
    spread = p.mismatch * math.hypot(p.threshold_on, p.threshold_off)
    differences = (p.threshold_on - p.threshold_off + spread * node) / mean
    a, tau_s = np.asarray(thresholds) / rms(p, f_hz), 1 / (2 * np.pi * bandwidth)
    at_nodes = noise_events(a[..., None], differences, (p.refractory_us * 1e-6 / tau_s)[..., None])
    weight = weight / weight.sum()
    on, off = (at_nodes.on * weight).sum(-1), (at_nodes.off * weight).sum(-1)
    events = (at_nodes.on + at_nodes.off) * weight / np.maximum(on + off, _LEAST_RATE)[..., None]
    return NoiseStatistics(
        on * bandwidth, off * bandwidth, (at_nodes.opposite * events).sum(-1), (at_nodes.gap * events).sum(-1) * tau_s
    )


def beyond_the_law(p: SensorParameters, f_hz: npt.ArrayLike) -> str:
    """Return the limits of the point process that a sensor's noise exceeds at some corner frequencies; empty: none."""
    f = np.atleast_1d(np.asarray(f_hz, np.float64))
    mean = (p.threshold_on + p.threshold_off) / 2
    least_a = mean / float(rms(p, f).max())
    if least_a < LEAST_A:
        return f"thresholds of {least_a:.2g} rms of the noise, and the law of noise events begins at {LEAST_A:g}"
    law = of_array(p, np.asarray(mean), f)
    under_way = (law.on + law.off) * np.maximum(2 * law.opposite - 1, 0) * law.gap
    if under_way.max() > MOST_UNDER_WAY:
        return "bursts of noise events overlap: rates hold, intervals and the order of polarities do not"
    return ""


def noise_scale(p: SensorParameters, seed: int) -> _Floats:
    """Return the rms of each pixel's noise over that of the parameters, (pixels,)."""
    pixel = np.arange(p.width * p.height)
    return np.exp(p.noise.spread * normal(seed, Purpose.NOISE_SPREAD, pixel))


def corner_hz(p: SensorParameters, light: npt.ArrayLike) -> _Floats:
    """Return the photoreceptor's corner frequency f, Hz, at a light; infinite where the sensor has no low-pass."""
    current = np.maximum(np.asarray(light, np.float64), 0) + p.dark_current_relative
    if math.isinf(p.corner_hz_at_reference):
        return np.full_like(current, np.inf)
    return np.clip(p.corner_hz_at_reference * current, p.corner_min_hz, p.corner_max_hz)


def fixed_corner_hz(p: SensorParameters) -> float:
    """Return the fixed pole of the noise, Hz: its own, or the signal's source follower; infinite: none."""
    return p.noise.corner_hz or p.source_follower_hz or math.inf


def _passed(p: SensorParameters, f_hz: _Floats) -> _Floats:
    """Return corner / (corner + f), 1 for infinite f or corner."""
    corner = fixed_corner_hz(p)
    return np.where(np.isinf(f_hz) | math.isinf(corner), 1.0, 1 / (1 + np.minimum(f_hz, 1e300) / corner))


def rms(p: SensorParameters, f_hz: npt.ArrayLike) -> _Floats:
    """Return sigma, ln units, where the photoreceptor's corner frequency is `f_hz`."""
    return np.asarray(p.noise.rms * np.sqrt(_passed(p, np.asarray(f_hz, np.float64))))


def bandwidth_hz(p: SensorParameters, f_hz: npt.ArrayLike) -> _Floats:
    """Return f_n, Hz, where the photoreceptor's corner frequency is `f_hz`."""
    f = np.asarray(f_hz, np.float64)
    return np.where(np.isinf(f), fixed_corner_hz(p), np.minimum(f, 1e300) * _passed(p, f))
