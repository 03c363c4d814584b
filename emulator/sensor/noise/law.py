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

from emulator.sensor.noise.hazard import Distance, Hazard, Noise, hazard, hazard_tables, noise_of, transition
from emulator.sensor.numerics.compiled import cached_entry, kernel
from emulator.sensor.numerics.keyed import high, low, normal_from, unit, word
from emulator.sensor.presets import SensorParameters

_Floats = npt.NDArray[np.float64]
_Float32s = npt.NDArray[np.float32]

_LEVELS, _BLUR = 96, 0.35  # of a grid of references: places; steps
_NODES = 5, 8  # of the sums and differences of a pixel's two thresholds; with an even number none are equal
_LONG_S, _FASTEST_HZ = 1e6, 1e12
_NO_HZ = 1e-30


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


@kernel
def still_hazard(on: float, off: float, noise: Noise, tables: _Float32s) -> Hazard:
    """Return the hazard of a pixel in still light, which has forgotten its reset, at distances from its thresholds."""
    h: Hazard = hazard(_LONG_S, Distance(on, off, 0.0, 0.0), 0.0, 0.0, noise, tables)
    return h


class Stay(NamedTuple):
    """Stay at a reference: its length, s; polarity of the event at its end; and the next reference less the signal."""

    length_s: float
    on: bool
    level: float


@kernel
def stay_at(  # noqa: PLR0913, PLR0917
    level: float, on: float, off: float, noise: Noise, dead_s: float, number: np.uint64, k: int, tables: _Float32s
) -> Stay:  # fmt: skip
    """Draw stay k of a chain of references in still light; `number` is the chain's stream of random numbers."""
    h = still_hazard(on + level, off - level, noise, tables)
    bits = word(number, 2 * k)
    total = max(h.on + h.off, _NO_HZ)
    is_on = unit(low(bits)) * total < h.on
    level += on if is_on else -off
    normal = noise.sigma * normal_from(word(number, 2 * k + 1))
    if noise.ratio == 0.0:
        decay = math.exp(-noise.rate * dead_s)
        level = level * decay + normal * math.sqrt(1 - decay * decay)
    elif dead_s > 0:
        m = transition(dead_s, noise)
        level = level * m.p11 + normal * math.sqrt(m.v)
    return Stay(-math.log(unit(high(bits))) / total, is_on, level)


@cached_entry
def _rates(  # noqa: PLR0913, PLR0917
    on: float, off: float, leak_hz: float, rate: float, pole: float, rms: float, high: float, dead_s: float,
    tables: _Float32s,
) -> Rates:  # fmt: skip
    """Return the rates of a pixel with thresholds on and off, from the shares of time that its references have.

    The shares on a grid of references are solved without a subtraction (Grassmann, Taksar and Heyman 1985), because the
    rates at which they are left differ by many orders of magnitude.
    """
    noise = noise_of(rate, pole, rms, high)
    grid = np.linspace(-on - noise.sigma, off + noise.sigma, _LEVELS)  # a reset may lead beyond a threshold
    kept, beyond = math.exp(-noise.rate * dead_s), 0.0
    step, lost = grid[1] - grid[0], 1 - kept * kept
    if noise.ratio > 0.0 and dead_s > 0:
        m = transition(dead_s, noise)
        slope = m.p12 * noise.rate  # at a passage it is distributed as Rayleigh's
        kept, beyond = m.p11, math.sqrt(math.pi / 2) * noise.sigma * slope
        lost = m.v + (2 - math.pi / 2) * slope**2
    width = math.sqrt(lost * noise.sigma**2 + (_BLUR * step) ** 2)
    rates, fires = np.zeros((_LEVELS, _LEVELS)), np.zeros((2, _LEVELS))
    for i, level in enumerate(grid):
        h = still_hazard(on + level, off - level, noise, tables)
        is_last = -on < level <= step - on  # from there leak comes to the threshold
        leaving = leak_hz * on / (on + level if is_last else step)
        ended = leaving if is_last else 0.0
        up, down = (level + on) * kept + beyond, (level - off) * kept - beyond
        for hz, after in ((h.on + _NO_HZ, up), (h.off + _NO_HZ, down), (ended, 0.0)):
            weights = np.exp(-0.5 * ((grid - min(max(after, grid[0]), grid[-1])) / width) ** 2)
            rates[i] += hz / weights.sum() * weights
        fires[0, i], fires[1, i] = h.on + ended + _NO_HZ, h.off + _NO_HZ
        rates[i, max(i - 1, 0)] += _NO_HZ + leaving - ended
    for i in range(_LEVELS - 1, 0, -1):
        rates[:i, i] /= rates[i, :i].sum()
        for j in range(i):
            rates[j, :i] += rates[j, i] * rates[i, :i]
    shares = np.ones(_LEVELS)
    for i in range(1, _LEVELS):
        shares[i] = (shares[:i] * rates[:i, i]).sum()
        shares[: i + 1] /= max(shares[i], 1.0)
    shares /= np.dot(shares, 1 + dead_s * (fires[0] + fires[1]))
    return Rates(np.dot(shares, fires[0]), np.dot(shares, fires[1]))


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
    rates = [_rates(x, y, p.leak_hz, *noise, dead_s, hazard_tables()) for x, y in zip(on, off, strict=True)]
    return Rates(*np.average(rates, axis=0, weights=np.outer(w0, w1).reshape(-1)).tolist())
