"""Statistics of noise events from first passages: the exact law that `law` interpolates in a table.

The noise is an Ornstein-Uhlenbeck process x, here in units of its deviation sigma and its time constant tau. A pixel
that was read anew at the level c fires when x, which starts at c, first leaves (c - off, c + on). It is then refractory
for the time rho, and is read anew at c' = x at its end, which is normal:

    c' = (c + on) e^-rho + sqrt(1 - e^(-2 rho)) N     after an ON event; after an OFF event c - off in place of c + on

So the levels are a Markov chain. With S(x) the integral of e^(y^2 / 2), and M(y) that of e^(-z^2 / 2) from the lower
end, the side of the exit and its mean time are

    P(ON | c) = (S(c) - S(low)) / (S(high) - S(low))
    T(c)      = P(ON | c) int_low^high S' M dy - int_low^c S' M dy

The rate follows from the chain's stationary density pi: 1 / sum pi (T + rho). The exit time is near to exponential, so
its square has the mean 2 sum pi T^2.

`python -m emulator.sensor.noise.first_passage` writes the table, some ten minutes.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = ["DIFFERENCE", "REFRACTORY", "TABLE", "A", "Statistics", "statistics", "write_table"]

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


def _exits(c: _Floats, on: float, off: float) -> tuple[_Floats, _Floats]:
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
    p_on, wait = _exits(c, on, off)
    edges = np.concatenate([[-np.inf], (c[1:] + c[:-1]) / 2, [np.inf]])
    decay = np.exp(-refractory)
    after_on, after_off = (
        np.diff(ndtr((edges - (level * decay)[:, None]) / deviation), axis=1) for level in (c + on, c - off)
    )
    chain = p_on[:, None] * after_on + (1 - p_on)[:, None] * after_off
    equations, one = chain.T - np.eye(c.size), np.zeros(c.size)
    equations[-1], one[-1] = 1, 1
    density = np.linalg.solve(equations, one)
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
