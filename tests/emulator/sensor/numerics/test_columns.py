"""Packed tables give an entry and the one behind it, and any place is safe."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.sensor.numerics.columns import fetch, packed
from emulator.sensor.numerics.compiled import vector_kernel

NUMBERS = st.lists(st.floats(0, 63.5, width=32), min_size=3, max_size=40)


@vector_kernel
def _pairs(table, places, out):
    for i in range(places.size):
        out[0, i], out[1, i] = fetch(table, places[i])


def pairs(values, places):
    out = np.zeros((2, len(places)), np.float32)
    _pairs(packed(values), np.asarray(places, np.float32), out)
    return out


@given(NUMBERS)
def test_an_entry_and_the_next_one_are_within_a_4096th(values):
    first, second = pairs(values, range(len(values) - 1))
    np.testing.assert_allclose(first, values[:-1], rtol=2**-12, atol=2**-26)
    np.testing.assert_allclose(second, values[1:], rtol=2**-12, atol=2**-26)


@pytest.mark.parametrize("place", [-1, -1e9, 1e9, np.nan, np.inf])
def test_a_place_outside_gives_the_last_pair(place):
    np.testing.assert_array_equal(pairs([1, 2, 3, 4], [place]), [[3], [4]])
