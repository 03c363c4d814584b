"""Rate of the events that temporal noise alone raises in still light.

The noise is a voltage n of rms sigma with one pole at f_n (an Ornstein-Uhlenbeck process). After an event the pixel's
level moves by a threshold, so an event needs a passage over a whole threshold theta; the rate of such first passages,
over f_n, depends on a = theta / sigma and on the refractory period in units of tau = 1 / (2 pi f_n), at whose end the
level is set again, usually on a peak of the noise. ON rate over f_n:

    a      refractory period over tau
           0       0.19     1.9      9.4
    2      1.13    1.02     .61      .25
    2.5    .574    .53      .33      .18
    3      .268    .26      .14      .10
    3.5    .0955   .11      .045     .037
    4      .0244   .035     .0097    .0086
    4.5    .0072   .0080    .0016    .0013

Simulated with steps of tau / 50 and hidden crossings by the Brownian bridge. The first column is for a pixel whose two
thresholds differ by some percent, as all do: with equal thresholds and no leak, the levels would stay on one lattice
for ever, and the rate would depend on its position (a = 3: .14 f_n with a level at the noise's mean, .54 with the mean
midway between two; a = 4: .006 and .26). From 0 to 0.19 tau the refractory period changes the rate by 10 % or so.

Leak moves the levels too, which the law leaves out: at a = 4 and f_n = 150 Hz, 0.1 Hz of leak raises the rate by two
thirds without a refractory period, by a tenth with one of tau (pixels of `grid`).

Between the columns the law runs in the square root of the refractory period, because that is how far a diffusion gets.
Between the rows and beyond them, log(rate / (a e^(-a^2/2))) runs straight in a^2. For thresholds that differ, a is
that of their mean (within 5 % for a difference of 10 %).

How sigma and f_n follow the light: a photoreceptor whose corner frequency f is proportional to its current has shot
noise of constant rms. A fixed pole `corner` behind it takes the fast part away:

    sigma^2 = rms^2 corner / (corner + f),    f_n = f corner / (corner + f)

so noise events are rare in bright light, and in the dark, where f is low. A sensor without a low-pass (infinite f) has
the fixed pole alone: sigma = rms, f_n = corner.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from emulator.sensor.presets import SensorParameters

__all__ = ["LEAST_A", "bandwidth_hz", "corner_hz", "rate_over_bandwidth", "rms"]

_Floats = npt.NDArray[np.float64]

LEAST_A = 1.5
"""Smallest threshold of the law, in sigma; lower ones count as this, because the pixel then fires all the time."""

_A = np.array([2.0, 2.5, 3.0, 3.5, 4.0, 4.5])
_REFRACTORY = np.array([0.0, 0.19, 1.9, 9.4])
_RATES = np.array(
    [
        [1.13, 1.02, 0.61, 0.25],
        [0.574, 0.53, 0.33, 0.18],
        [0.268, 0.26, 0.14, 0.10],
        [0.0955, 0.11, 0.045, 0.037],
        [0.0244, 0.035, 0.0097, 0.0086],
        [0.0072, 0.0080, 0.0016, 0.0013],
    ]
)
_SHAPE = np.log(_RATES / (_A * np.exp(-(_A**2) / 2))[:, None])


def _place(x: _Floats, nodes: _Floats) -> tuple[npt.NDArray[np.int64], _Floats]:
    """Return the interval of `nodes` that contains x, and the share in it; outside, the outermost interval extended."""
    k = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, nodes.size - 2)
    return k, (x - nodes[k]) / (nodes[k + 1] - nodes[k])


def rate_over_bandwidth(a: npt.ArrayLike, refractory_over_tau: npt.ArrayLike) -> _Floats:
    """Return the ON rate over f_n for thresholds of `a` sigma; arguments broadcast."""
    a = np.maximum(np.asarray(a, np.float64), LEAST_A)
    refractory = np.clip(np.asarray(refractory_over_tau, np.float64), 0, _REFRACTORY[-1])
    row, down = _place(a**2, _A**2)
    column, along = _place(np.sqrt(refractory), np.sqrt(_REFRACTORY))
    upper, lower = (_SHAPE[r, column] * (1 - along) + _SHAPE[r, column + 1] * along for r in (row, row + 1))
    return np.asarray(a * np.exp(upper * (1 - down) + lower * down - a**2 / 2))


def corner_hz(p: SensorParameters, light: npt.ArrayLike) -> _Floats:
    """Return the photoreceptor's corner frequency f, Hz, at a light; infinite where the sensor has no low-pass."""
    current = np.maximum(np.asarray(light, np.float64), 0) + p.dark_current_relative
    if math.isinf(p.corner_hz_at_reference):
        return np.full_like(current, np.inf)
    return np.clip(p.corner_hz_at_reference * current, p.corner_min_hz, p.corner_max_hz)


def _passed(p: SensorParameters, f_hz: _Floats) -> _Floats:
    """Return corner / (corner + f), 1 for infinite f."""
    return np.where(np.isinf(f_hz), 1.0, p.noise.corner_hz / (p.noise.corner_hz + f_hz))


def rms(p: SensorParameters, f_hz: npt.ArrayLike) -> _Floats:
    """Return sigma, ln units, where the photoreceptor's corner frequency is `f_hz`."""
    return np.asarray(p.noise.rms * np.sqrt(_passed(p, np.asarray(f_hz, np.float64))))


def bandwidth_hz(p: SensorParameters, f_hz: npt.ArrayLike) -> _Floats:
    """Return f_n, Hz, where the photoreceptor's corner frequency is `f_hz`."""
    f = np.asarray(f_hz, np.float64)
    return np.where(np.isinf(f), p.noise.corner_hz, f * p.noise.corner_hz / (p.noise.corner_hz + np.minimum(f, 1e300)))
