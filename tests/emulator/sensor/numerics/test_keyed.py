"""Keyed randomness. Each statistical test fails a good generator with a probability of 1e-4 (the seeds are fixed)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from emulator.sensor.numerics.keyed import Purpose, normal, uniform, words

ALPHA = 1e-4
PIXELS = np.arange(200_000)
ON, PHASE = Purpose.THRESHOLD_ON, Purpose.LEAK_PHASE
GOLDEN = [17357127767917823981, 15759789610668606014, 2501701743165286305]


@pytest.mark.parametrize("seed", [0, 1, 12345678901234567890, -1])
def test_uniforms_are_uniform_over_pixels_and_over_indices(seed):
    for draws in (uniform(seed, ON, PIXELS), uniform(seed, ON, 17, PIXELS)):
        assert stats.kstest(draws, "uniform").pvalue > ALPHA
        assert np.all((draws > 0) & (draws < 1))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_normals_are_normal(seed):
    assert stats.kstest(normal(seed, ON, PIXELS), "norm").pvalue > ALPHA
    assert stats.kstest(normal(seed, ON, 3, PIXELS), "norm").pvalue > ALPHA


def test_neighbours_purposes_seeds_and_indices_are_not_correlated():
    a = uniform(1, ON, PIXELS)
    others = [a[1:], a[346:], uniform(1, PHASE, PIXELS), uniform(2, ON, PIXELS), uniform(1, ON, PIXELS, 1)]
    for b in others:
        n = min(a.size, b.size)
        assert stats.pearsonr(a[:n], b[:n]).pvalue > ALPHA / len(others)


def test_each_bit_is_set_half_the_time_and_flips_with_any_bit_of_the_input():
    bits = np.unpackbits(words(9, ON, PIXELS).view(np.uint8).reshape(-1, 8), axis=1)
    counts = bits.sum(axis=0)
    assert np.all(np.abs(counts - PIXELS.size / 2) < stats.norm.isf(ALPHA / 128) * np.sqrt(PIXELS.size / 4))
    for bit in range(17):
        changed = words(9, ON, PIXELS) ^ words(9, ON, PIXELS ^ (1 << bit))
        flips = np.unpackbits(changed.view(np.uint8)).sum() / 2  # each pair is there twice
        n = changed.size * 32
        assert abs(flips - n / 2) < stats.norm.isf(ALPHA / 34) * np.sqrt(n / 4)


@given(seed=st.integers(-(2**70), 2**70), pixel=st.integers(0, 2**40), index=st.integers(0, 2**62))
def test_a_draw_depends_on_its_key_alone(seed, pixel, index):
    alone = uniform(seed, ON, pixel, index)[0]
    assert uniform(seed, ON, np.array([3, pixel, 7]), np.array([1, index, index]))[1] == alone
    assert words(seed, PHASE, pixel, index)[0] != words(seed, ON, pixel, index)[0]


def test_what_a_seed_means_does_not_change():
    """Golden values: a recorded rig must give the same sensor in every release."""
    assert words(1, ON, [0, 1, 2]).tolist() == GOLDEN
