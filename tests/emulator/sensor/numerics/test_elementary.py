"""The float32 logarithm and decay against float64."""

import numpy as np
from numba import njit

from emulator.sensor.numerics.elementary import decay, lowest_bit, natural_log


@njit
def logs(x, out):
    for i in range(x.size):
        out[i] = natural_log(x[i])


@njit
def decays(s, out):
    for i in range(s.size):
        out[i] = decay(s[i])


@njit
def lowest(words, out):
    for i in range(words.size):
        out[i] = lowest_bit(words[i])


def test_the_logarithm_is_good_to_its_last_bits_over_all_floats():
    x = np.concatenate([10.0 ** np.linspace(-37, 38, 300_001), np.linspace(0.5, 2, 300_001)]).astype(np.float32)
    out = np.empty_like(x)
    logs(x, out)
    exact = np.log(x.astype(np.float64))
    assert np.all(np.abs(out - exact) <= np.maximum(2e-7 * np.abs(exact), 1e-12))


def test_the_decay_is_good_to_its_last_bits_from_nanoseconds_to_for_ever():
    s = np.concatenate([10.0 ** np.linspace(-30, 1.9, 300_001), [0.0, 80.0]]).astype(np.float32)
    out = np.empty_like(s)
    decays(s, out)
    exact = -np.expm1(-s.astype(np.float64))
    assert np.all(np.abs(out - exact) <= 3e-7 * exact)
    decays(np.array([100, 1e30, np.inf], np.float32), out[:3])
    assert np.all(out[:3] == 1)


def test_the_lowest_bit():
    words = np.array([1, 2, 3, 12, 1 << 63, (1 << 63) | (1 << 40)], np.uint64)
    out = np.empty(words.size, np.int64)
    lowest(words, out)
    assert out.tolist() == [0, 1, 0, 2, 63, 40]
