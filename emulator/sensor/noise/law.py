"""Noise of a sensor's comparators by its parameters: rms and poles in a light, and rates of events in still light.

    sigma^2 = rms^2 corner / (corner + f)       f: of the photoreceptor, in proportion to the photocurrent, Hz
                                                corner: of the fixed pole behind it

so noise events are rare in bright light, and in the dark, where f is low. A sensor without a low-pass (infinite f) has
the fixed pole alone, and one without a fixed pole the receptor's: sigma = rms for both.

Rates in still light follow from a Markov chain of a pixel's references: it stays at one for an exponential time, and
the next one is the noise at the end of the dead time. They are for plans, bounds and the start of a stream; the events
themselves follow from the hazard of each pixel at each instant.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.noise.hazard import Distance, Hazard, Noise, hazard, hazard_tables, noise_of, transition
from emulator.sensor.numerics.compiled import cached_entry, kernel
from emulator.sensor.numerics.keyed import high, low, normal_from, stream, unit, word
from emulator.sensor.presets import SensorParameters

_Floats = npt.NDArray[np.float64]
_Float32s = npt.NDArray[np.float32]

_EVENTS = 4000  # of a chain
_NODES = 7  # of the differences between the two thresholds of the pixels
_LONG_S = 1e6
_FASTEST_HZ = 1e12
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
    """Stay at a reference: its length, s, the polarity of the event that ends it, and the next reference.

    References are relative to the signal, ln units.
    """

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
def _chain(on: float, off: float, rate: float, pole: float, rms: float, dead_s: float, tables: _Float32s) -> Rates:  # noqa: PLR0913, PLR0917
    """Return the rates of a pixel with thresholds on and off and a receptor of `rate`, 1/s, from a chain of events."""
    noise, number = noise_of(rate, pole, rms), stream(np.uint64(1), 0)
    level = time_s = 0.0
    ons = 0
    for k in range(_EVENTS):
        stay = stay_at(level, on, off, noise, dead_s, number, k, tables)
        level = stay.level
        time_s += stay.length_s + dead_s
        ons += stay.on
    return Rates(ons / time_s, (_EVENTS - ons) / time_s)


def still_hz(p: SensorParameters, f_hz: float) -> Rates:
    """Return the rates of noise events of a pixel in still light, averaged over the mismatch of its thresholds.

    `f_hz` is the corner frequency of the photoreceptor. Within a factor of 1.3 for thresholds of 1.6 deviations and
    more, without leak.
    """
    if not p.noise.rms:
        return Rates(0.0, 0.0)
    pole = fixed_corner_hz(p)
    per_s = 2 * math.pi * min(float(f_hz), _FASTEST_HZ)
    node, weight = np.polynomial.hermite_e.hermegauss(_NODES)
    on = off = 0.0
    for x, share in zip(node, weight / weight.sum(), strict=True):
        spread = p.mismatch * math.sqrt(0.5) * x  # of the mean of a pixel's two thresholds, which decides
        thresholds = (max(t * (1 + spread), 0.1 * t) for t in (p.threshold_on, p.threshold_off))
        fixed = 0.0 if math.isinf(pole) else 2 * math.pi * pole
        rates = _chain(*thresholds, per_s, fixed, p.noise.rms, p.refractory_us * 1e-6, hazard_tables())
        on, off = on + share * rates.on, off + share * rates.off
    return Rates(float(on), float(off))
