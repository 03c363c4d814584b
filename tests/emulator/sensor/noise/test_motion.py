"""Noise beside a moving signal: sines, ramps and edges, beside an independent Monte Carlo.

That followed noise, comparator and dead time as in `test_still_light`. Sines: 192 pixels of evenly spread phases,
thresholds spread by 12 % and rms by 15 %, those of this generator and seed; dead time 20 us. Without noise the first
three sines have 4.8, 14.4 and 51.0 events a pixel and second. Ramps: intervals of events over those of thresholds.
Edges: a logistic rise of 3.4 thresholds; the time of each pixel's first event after its middle.

Rates are compared within 3 %, or 3.9 standard errors of both where that is more; means of ramps and edges within 2 %,
spreads within 5 %, or that many errors. A solver that is right fails in one of 10 000 cases.
"""

import math

import numpy as np
import pytest

from emulator.sensor.pixels.state import Field
from tests.emulator.sensor.noise.noisy_arrays import (
    THRESHOLD,
    begun,
    ends,
    events_of,
    frame,
    one_pole,
    ramp,
    run,
    set_references,
    set_thresholds,
    sine,
    statistics_of,
    two_poles,
)

Z = 3.9
PIXELS = 192
PHASES = 2 * math.pi * np.arange(PIXELS) / PIXELS

# tau 1, tau 2, us; threshold over sigma; amplitude, Hz; rate of a pixel, Hz, its error; share of opposite successors.
SINES = [
    (0, 136.3, 7.98, 0.25, 2, 10.17, 0.008, 0.497),
    (0, 136.3, 7.98, 0.5, 2, 19.66, 0.006, 0.255),
    (0, 136.3, 7.98, 1.5, 2, 56.90, 0.004, 0.080),
    (0, 136.3, 7.98, 2.0, 10, 364.1, 0.002, 0.055),
    (0, 570, 5.365, 0.25, 2, 20.93, 0.004, 0.712),
    (0, 570, 5.365, 0.5, 0.5, 17.83, 0.005, 0.783),
    (0, 1913, 5.068, 0.5, 2, 20.72, 0.004, 0.295),
    (52.6, 84, 7.8, 0.25, 2, 8.93, 0.012, 0.517),
    (52.6, 84, 5.2, 0.25, 2, 40.01, 0.006, 0.858),
    (52.6, 84, 5.2, 2.0, 10, 348.0, 0.007, 0.066),
    (52.6, 84, 3.0, 1.5, 2, 474.2, 0.003, 0.873),
    (487, 84, 7.8, 0.5, 2, 16.99, 0.006, 0.236),
    (487, 84, 5.2, 0.25, 2, 15.40, 0.006, 0.648),
    (487, 84, 3.0, 0.5, 2, 127.1, 0.002, 0.839),
    (1900, 84, 5.2, 0.5, 2, 18.20, 0.006, 0.240),
]
# tau, us; threshold over sigma; thresholds a second; mean interval and its quantiles 5 and 95 %, thresholds over speed.
RAMPS = [
    (136, 7.8, 10, 0.9469, 0.783, 1.109),
    (136, 7.8, 100, 0.9689, 0.768, 1.166),
    (136, 7.8, 1000, 1.0070, 0.742, 1.269),
    (136, 7.8, 10_000, 1.1986, 0.994, 1.421),
    (570, 5.2, 10, 0.6355, 0.022, 1.117),
    (570, 5.2, 1000, 1.0164, 0.650, 1.415),
    (1000, 3.0, 10, 0.0954, 0.010, 0.397),
    (1000, 3.0, 100, 0.7094, 0.111, 1.366),
    (1000, 3.0, 10_000, 1.2011, 0.979, 1.455),
    (1000, 2.0, 100, 0.2715, 0.045, 0.786),
    (1000, 2.0, 1000, 0.9958, 0.355, 1.913),
]
# tau, us; threshold over sigma; width of the edge, us; mean time of the first event, us, and its standard deviation.
EDGES = [(136, 7.8, 2, -1.79, 0.54), (136, 7.8, 20, -17.9, 5.3), (136, 7.8, 200, -188.7, 55.2)]


@pytest.mark.sampled
@pytest.mark.parametrize(("tau1_us", "tau2_us", "a", "amplitude", "hz", "rate_hz", "error", "opposite"), SINES)
def test_events_of_a_sine(tau1_us, tau2_us, a, amplitude, hz, rate_hz, error, opposite):
    p = one_pole(a, tau2_us * 1e-6) if not tau1_us else two_poles(a, tau1_us * 1e-6, tau2_us * 1e-6)
    light, seconds = sine(amplitude, hz, PHASES), 2.0 if rate_hz > 100 else 8.0
    array = begun(p, light)
    random = np.random.default_rng(1)
    on, off = (THRESHOLD * (1 + 0.12 * random.standard_normal(PIXELS)) for _ in range(2))
    set_thresholds(array, on, off, np.exp(0.15 * random.standard_normal(PIXELS)))
    array.reset(frame(p, light, 0))
    found = statistics_of(run(array, light, ends(40 / hz / max(1, 2 * amplitude), seconds * 1e3)), seconds)
    ours = 1 / math.sqrt(rate_hz * PIXELS * seconds)  # pixels have different rates, but the same as there
    assert abs(found.rate_hz / rate_hz - 1) < max(0.03, Z * math.hypot(ours, error)), found.rate_hz / rate_hz
    assert found.opposite == pytest.approx(opposite, abs=max(0.01, Z * ours))


@pytest.mark.parametrize(("tau_us", "a", "speed", "mean", "low", "high"), RAMPS)
def test_intervals_on_a_ramp(tau_us, a, speed, mean, low, high):
    p, light, until_s = one_pole(a, tau_us * 1e-6), ramp(speed * THRESHOLD, 1e-3), 40 / speed
    waits = statistics_of(events_of(p, light, ends(until_s * 25, until_s * 1e3)), until_s).waits_s * speed
    assert waits.mean() == pytest.approx(mean, rel=max(0.02, Z * waits.std() / math.sqrt(waits.size) / mean))
    assert np.subtract(*np.quantile(waits, [0.95, 0.05])) == pytest.approx(high - low, rel=0.05)


@pytest.mark.parametrize(("tau_us", "a", "width_us", "mean_us", "deviation_us"), EDGES)
def test_the_first_event_of_an_edge(tau_us, a, width_us, mean_us, deviation_us):
    p = one_pole(a, tau_us * 1e-6, width=64, height=48, random_start=False)
    middle_us = max(20 * width_us, 12 * tau_us)

    def light(t_s):
        rise = 1 / (1 + math.exp(-max((t_s * 1e6 - middle_us) / width_us, -99)))
        level = math.exp(3.4 * THRESHOLD * rise)
        return level, level * 3.4 * THRESHOLD * rise * (1 - rise) / width_us * 1e6

    array = begun(p, light)
    first_references = np.random.default_rng(2).standard_normal(64 * 48) * THRESHOLD / a  # left by noise, as there
    set_references(array, array.field(Field.REFERENCE).reshape(-1) + first_references)
    times_us = [middle_us - 8 * width_us, *(middle_us + width_us * np.arange(-7.5, 6.5, 0.5))]
    found = run(array, light, [round(t * 1e3) for t in times_us])
    late = (found.t_ns > times_us[0] * 1e3) & found.on
    pixel, first = np.unique(found.pixel[late], return_index=True)
    t_us = found.t_ns[late][first] * 1e-3 - middle_us
    error = deviation_us / math.sqrt(t_us.size)
    assert pixel.size > 0.99 * 64 * 48
    assert abs(t_us.mean() - mean_us) < max(0.02 * abs(mean_us), Z * error)
    assert abs(t_us.std() - deviation_us) < max(0.05 * deviation_us, Z * error)
