"""The benchmark of noise: its measures on streams made by hand, and a small run of each kind of light.

A ratio fails where it is off its target by 4.5 of its standard errors, which one on target does with a probability of
1e-4: the errors are the spread of 32 groups. The seeds are fixed.
"""

import math

import numpy as np
import pytest
from scipy import stats

from emulator.sensor.parameters import NoiseParameters
from laboratory.accuracy.harness import Case
from laboratory.accuracy.noise import Measured, alike, behaviour, measured, of_pixels, of_reference, sensor
from laboratory.accuracy.scenes import LogSine, SlowRamp
from laboratory.accuracy.scores import Stream

Z = stats.t.isf(1e-4 / 2, 31)


def test_events_are_alike_at_the_same_time_in_the_same_pixel_and_polarity():
    true = Stream.of([10, 20, 30, 10], [0, 0, 1, 2], [True, False, True, True], 3)
    other = Stream.of([10, 20.5, 30, 10], [0, 0, 2, 2], [True, False, True, False], 3)
    assert alike(true, true) == 1
    assert alike(other, true) == 0.25


def test_a_ratio_has_the_error_of_its_groups_and_misses_its_target_beyond_two():
    random = np.random.default_rng(1)
    pixel = np.arange(800)
    ours, true = (
        Stream.of(random.uniform(0, 1e6, counts.sum()), np.repeat(pixel, counts), np.ones(counts.sum(), bool), 800)
        for counts in (random.poisson(12, 800), random.poisson(10, 800))
    )
    (rate,) = measured([("Hz", lambda stream: len(stream) / 800, 0.03)], ours, true)
    assert rate.ratio == pytest.approx(1.2, abs=4 * rate.error)
    assert 0.6 < rate.error / math.sqrt(22 / 100 / 800) < 1.5  # 99 % of the spreads of 32 numbers
    assert rate.is_off
    assert not rate._replace(target=0.2 + rate.error).is_off
    assert str(rate).endswith("*")
    assert not Measured("x", math.nan, 1.0, 0.0, 0.1).is_off


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("poles", [1, 2])
@pytest.mark.parametrize(
    "scene", [LogSine(128, 0.0, level=0.1), LogSine(128, 0.5, 2.0, 0.1), SlowRamp(128, 0.5, 2.0, 0.05)],
    ids=["still", "sine", "ramp"],
)  # fmt: skip
def test_pixels_have_the_rates_order_and_intervals_of_the_reference(scene, poles):
    noise = NoiseParameters(0.065, 1900.0 * (poles - 1))  # an rms 6 % larger fails in still light
    case = Case("noise", scene, sensor(0.4, poles, "large_signal", 128, noise=noise), 2.0)
    true = of_reference(case)
    for step_s in (1e-3, 8e-2):
        for quantity in measured(behaviour(2.0), of_pixels(case, step_s), true):
            assert abs(quantity.ratio - 1) < quantity.target + Z * quantity.error, (step_s, str(quantity))
