"""The random points of a pixel's field: one in 1e9 ns and Hz in the mean, Poisson, whatever the windows.

Each statistical test fails a good field with a probability of 1e-4; seeds are fixed.
"""

import itertools
import math

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from emulator.sensor.numerics.keyed import (
    BANDS,
    CERTAIN_HZ,
    NEVER_NS,
    TOP_HZ,
    Purpose,
    next_point,
    normal,
    normal_of,
    root_of,
    stream,
    word,
    words,
)

ALPHA = 1e-4
LEAST_HZ = 1e9 / 2**31
EDGES_HZ = [0.0, *(LEAST_HZ * 4**band for band in range(BANDS))]


@numba.njit
def points(base, from_ns, to_ns, below_hz):
    """Times and hazards of all points of a stream."""
    t_ns, hz = [np.int64(0) for _ in range(0)], [0.0 for _ in range(0)]
    point = next_point(base, from_ns, to_ns, below_hz)
    while point.t_ns != NEVER_NS:
        t_ns.append(point.t_ns)
        hz.append(point.hz)
        point = next_point(base, point.t_ns, to_ns, below_hz)
    return np.array(t_ns), np.array(hz)


def of_pixel(pixel, from_ns, to_ns, below_hz, seed=1):
    return points(np.uint64(stream(root_of(seed, Purpose.NOISE_EVENTS), pixel)), from_ns, to_ns, below_hz)


@pytest.mark.parametrize("band", range(BANDS))
def test_each_band_has_its_number_of_points(band):
    low, high = EDGES_HZ[band : band + 2]
    span_ns = round(50 / (high - low) * 1e9)
    hz = [of_pixel(pixel, -7, span_ns - 7, high)[1] for pixel in range(200)]
    counts = np.array([np.count_nonzero(one >= low) for one in hz])
    assert stats.poisson.interval(1 - ALPHA, 50 * counts.size)[0] <= counts.sum()
    assert counts.sum() <= stats.poisson.interval(1 - ALPHA, 50 * counts.size)[1]
    dispersion = counts.var(ddof=1) / counts.mean() * (counts.size - 1)
    assert abs(stats.chi2.cdf(dispersion, counts.size - 1) - 0.5) < 0.5 - ALPHA / 2
    inside = np.concatenate([one[one >= low] for one in hz])
    assert stats.kstest(inside, "uniform", (low, high - low)).pvalue > ALPHA


def test_points_come_at_random_in_time():
    """Waits are exponential, cells of 2^28 ns and their like leave no trace, and pixels have points of their own."""
    t_ns, _ = of_pixel(3, 0, 4 * 10**12, 2.5)
    waits = np.diff(t_ns)
    assert stats.kstest(waits, "expon", (0, 1e9 / 2.5)).pvalue > ALPHA
    for bits in (28, 26, 24):
        assert stats.chisquare(np.histogram(t_ns % (1 << bits), bins=32, range=(0, 1 << bits))[0]).pvalue > ALPHA
    after, before = waits[1:], waits[:-1]
    assert stats.spearmanr(before, after).pvalue > ALPHA
    slots = [np.bincount(of_pixel(pixel, 0, 10**12, 2.5)[0] // 10**9, minlength=1001)[:1000] for pixel in range(2)]
    assert stats.pearsonr(*slots).pvalue > ALPHA


@given(
    cuts=st.lists(st.integers(0, 10**9), max_size=20),
    begin_ns=st.integers(-(2**61), 2**61),
    below_hz=st.floats(0.01, 1e4),
    pixel=st.integers(0, 2**24),
)
def test_windows_divide_the_points_among_them(cuts, begin_ns, below_hz, pixel):
    """In any division of time: none is lost, none comes twice, and those below a lower hazard are some of them."""
    edges = sorted({begin_ns, begin_ns + 10**9, *(begin_ns + cut for cut in cuts)})
    t_ns, hz = of_pixel(pixel, edges[0], edges[-1], below_hz)
    parts = [of_pixel(pixel, *ends, below_hz) for ends in itertools.pairwise(edges)]
    assert np.array_equal(np.concatenate([part[0] for part in parts]), t_ns)
    assert np.array_equal(np.concatenate([part[1] for part in parts]), hz)
    assert np.all((t_ns > edges[0]) & (t_ns <= edges[-1]) & (hz < below_hz))
    lower = of_pixel(pixel, edges[0], edges[-1], below_hz / 3)
    assert np.array_equal(lower[0], t_ns[hz < below_hz / 3])


def test_of_two_points_at_one_time_the_lower_one_counts():
    """This pixel has two points at 201077062 ns, of 1413 and of 557 / s, the upper one drawn first."""
    for below_hz in (1671.0, 557.0):
        t_ns, hz = of_pixel(6753, 0, 10**9, below_hz)
        assert hz[t_ns == 201_077_062].tolist() == pytest.approx([556.9], abs=0.1)


@given(from_ns=st.integers(-(2**61), 2**61), pixel=st.integers(0, 2**24))
def test_above_the_highest_band_there_are_no_points(from_ns, pixel):
    t_ns, hz = of_pixel(pixel, from_ns, from_ns + 20_000, CERTAIN_HZ)
    assert np.array_equal(of_pixel(pixel, from_ns, from_ns + 20_000, TOP_HZ)[0], t_ns)
    assert 90 < t_ns.size < 230  # 156 in the mean
    assert np.all(hz < TOP_HZ)


@given(seed=st.integers(-(2**70), 2**70), pixel=st.integers(0, 2**40), index=st.integers(0, 2**62))
def test_loops_draw_the_numbers_of_the_streams(seed, pixel, index):
    bits = word(np.uint64(stream(root_of(seed, Purpose.NOISE_EVENTS), pixel)), index)
    assert bits == words(seed, Purpose.NOISE_EVENTS, pixel, index)[0]
    drawn = normal_of(np.uint64(bits))
    assert drawn == pytest.approx(normal(seed, Purpose.NOISE_EVENTS, pixel, index)[0], rel=1e-9, abs=1e-9)
    assert math.isfinite(drawn)
