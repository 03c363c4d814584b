"""Traces of the picture rate in event times, against streams whose traces are known."""

import numpy as np
import pytest

from laboratory.accuracy.rendering import comb_of

STEP_US = 1000.0


def test_even_times_show_no_trace():
    t = np.random.default_rng(1).uniform(0, 200 * STEP_US, 400_000)
    comb = comb_of(t, STEP_US)
    assert comb.middle_share == pytest.approx(0.05, abs=0.002)  # 6 standard deviations
    assert comb.second_half == pytest.approx(0.0, abs=0.01)
    assert comb.line < 20  # of 8 exponential variables, over their median: above 20 once in 1e5


def test_times_in_the_middle_of_steps_are_found():
    rng = np.random.default_rng(2)
    even = rng.uniform(0, 200 * STEP_US, 90_000)
    comb = comb_of(np.concatenate((even, (rng.integers(0, 200, 10_000) + 0.5) * STEP_US)), STEP_US)
    assert comb.middle_share == pytest.approx(0.9 * 0.05 + 0.1, abs=0.005)
    assert comb.line > 500  # (1e4 / 2)^2 over 1e5 * 3/8 * ln 2 is 960


def test_a_lean_to_the_second_half_is_found():
    rng = np.random.default_rng(3)
    phase = np.where(rng.random(100_000) < 0.6, rng.uniform(0.5, 1, 100_000), rng.uniform(0, 0.5, 100_000))
    comb = comb_of((rng.integers(0, 200, 100_000) + phase) * STEP_US, STEP_US)
    assert comb.second_half == pytest.approx(0.5, abs=0.05)
