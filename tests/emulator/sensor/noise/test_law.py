"""The law of noise events: the chain of first passages against an Ornstein-Uhlenbeck process followed in fine steps.

Rates of the simulation have a standard error that is found from the spread between its pixels; a comparison fails a
good law with a probability of 1e-4 or less, 2 % being added for the simulation's step. The seeds are fixed.
"""

import dataclasses

import numpy as np
import pytest
from emulator.sensor.noise.points import NoiseEvents
from scipy import stats

from emulator.sensor.noise.law import (
    DIFFERENCE,
    REFRACTORY,
    TABLE,
    A,
    bandwidth_hz,
    corner_hz,
    noise_events,
    of_array,
    statistics,
)
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.crossings import joined
from emulator.sensor.presets import SensorParameters
from tests.emulator.sensor.noise.ornstein_uhlenbeck import passages

ALPHA = 1e-4
STEP_ERROR = 0.02
MS = 1_000_000


def simulated(on, off, refractory, seconds, pixels):
    """Mean ON and OFF rate over f_n with their standard errors, and the share of opposite successors."""
    found = passages(on, off, refractory, seconds, pixels, np.random.default_rng(7))
    pixel, _, polarity = (np.array(column) for column in zip(*found, strict=True))
    rates = []
    for one in (1, 0):
        counts = np.bincount(pixel[polarity == one], minlength=pixels) * 2 * np.pi / seconds
        rates.append((counts.mean(), counts.std() / np.sqrt(pixels)))
    same_pixel = np.diff(pixel) == 0
    return *rates, np.mean(np.diff(polarity)[same_pixel] != 0)


CASES = [(3.0, 3.0, 0.19, 500.0, 150), (3.6, 3.3, 0.02, 1000.0, 150), (2.5, 2.5, 1.0, 300.0, 150),
         (3.2, 2.6, 3.0, 500.0, 150)]  # fmt: skip


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize(("on", "off", "refractory", "seconds", "pixels"), CASES)
def test_the_law_is_that_of_a_finely_followed_process(on, off, refractory, seconds, pixels):
    law, here = statistics(on, off, refractory), simulated(on, off, refractory, seconds, pixels)
    for found, (rate, error) in zip((law.on, law.off), here, strict=False):
        assert abs(found - rate) < stats.norm.isf(ALPHA / 2) * error + STEP_ERROR * rate
    assert law.opposite == pytest.approx(here[2], abs=0.01)


@pytest.mark.parametrize(("on", "off", "refractory", "seconds", "pixels"), CASES)
def test_the_table_between_its_nodes_is_near_the_law(on, off, refractory, seconds, pixels):
    mean, law = (on + off) / 2, statistics(on, off, refractory)
    found = noise_events(mean, (on - off) / mean, refractory)
    assert float(found.on) == pytest.approx(law.on, rel=0.08)
    assert float(found.off) == pytest.approx(law.off, rel=0.08)
    assert float(found.opposite) == pytest.approx(law.opposite, abs=0.01)


@pytest.mark.parametrize("place", [(3, 0, 4), (5, 2, 5), (0, 6, 7)])
def test_the_table_is_what_the_law_gives(place):
    a, apart, refractory = A[place[0]], DIFFERENCE[place[1]], REFRACTORY[place[2]]
    law = statistics(a * (1 + apart / 2), a * (1 - apart / 2), refractory)
    assert np.load(TABLE)[place] == pytest.approx(law, rel=1e-5, abs=1e-6)


@pytest.mark.long
@pytest.mark.system
def test_what_was_off_by_two_is_not():
    """Noise of 0.055 rms behind 286 Hz, corner 90 Hz, threshold 0.2, 0.1 ms: 4.2 deviations, 0.043 time constants."""
    p = SensorParameters(
        width=64, height=48, threshold_on=0.2, threshold_off=0.2, mismatch=0.0, corner_hz_at_reference=90.0,
        refractory_us=100.0, leak_hz=0.0, noise=NoiseParameters(rms=0.055, corner_hz=286.0),
    )  # fmt: skip
    f = corner_hz(p, 1.0)
    tau_s = 1 / (2 * np.pi * float(bandwidth_hz(p, f)))
    a = 0.2 / (0.055 * np.sqrt(286 / (286 + float(f))))
    (on, on_error), (off, off_error), _ = simulated(a, a, 1e-4 / tau_s, 10_000.0, 50)
    truth_hz, error_hz = (on + off) / (2 * np.pi * tau_s), np.hypot(on_error, off_error) / (2 * np.pi * tau_s)
    noise = NoiseEvents(p, 1, np.full(64 * 48, 0.2))
    noise.step(np.ones(64 * 48, np.float32), 40_000 * MS)  # the reference settles for 10 000 time constants, 23 s
    found = noise.step(np.ones(64 * 48, np.float32), 50_000 * MS)
    counts = np.bincount(found.pixel, minlength=64 * 48) / 10
    error_hz = np.hypot(error_hz, counts.std() / np.sqrt(counts.size))
    assert abs(counts.mean() - truth_hz) < stats.norm.isf(ALPHA / 2) * error_hz + (STEP_ERROR + 0.03) * truth_hz


def test_the_lower_threshold_fires_more_often():
    p = SensorParameters(
        width=8, height=8, threshold_on=0.22, threshold_off=0.18, mismatch=0.0, corner_hz_at_reference=300.0,
        noise=NoiseParameters(rms=0.08, corner_hz=300.0),
    )  # fmt: skip
    law = of_array(p, np.array(0.2), corner_hz(p, 1.0))
    assert float(law.off / law.on) == pytest.approx(0.22 / 0.18, rel=0.02)  # the levels stay near the noise's mean
    slow = dataclasses.replace(p, refractory_us=20_000.0)
    law = of_array(slow, np.array(0.2), corner_hz(slow, 1.0))
    assert float(law.off / law.on) > 1.5
    noise = NoiseEvents(slow, 1, np.repeat([[0.22], [0.18]], 64, axis=1))
    found = joined([noise.step(np.ones(64, np.float32), t) for t in range(50 * MS, 60_001 * MS, 50 * MS)])
    assert found.on.mean() == pytest.approx(float(law.on / (law.on + law.off)), abs=0.01)


def test_signal_and_noise_have_the_same_fixed_pole():
    p = SensorParameters(width=4, height=4, threshold_on=0.2, threshold_off=0.2, noise=NoiseParameters(rms=0.05))
    assert bandwidth_hz(p, 1000.0) == 1000.0
    behind = dataclasses.replace(p, source_follower_hz=250.0)
    assert bandwidth_hz(behind, 1000.0) == pytest.approx(200.0)
    own = dataclasses.replace(behind, noise=NoiseParameters(rms=0.05, corner_hz=1000.0))
    assert bandwidth_hz(own, 1000.0) == pytest.approx(500.0)


@pytest.mark.filterwarnings("error")
def test_noise_far_below_the_thresholds_is_silent():
    p = SensorParameters(
        width=4,
        height=4,
        threshold_on=0.2,
        threshold_off=0.2,
        source_follower_hz=286.0,
        noise=NoiseParameters(rms=2e-3),
    )
    noise = NoiseEvents(p, 1, np.full(16, 0.2))
    assert len(noise.step(np.ones(16, np.float32), 1000 * MS)) == 0
