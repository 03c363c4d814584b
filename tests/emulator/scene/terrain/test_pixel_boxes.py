"""Means of the map's moments over boxes, against scipy's interpolation."""

import numpy as np
import pytest
from numba import njit
from scipy.interpolate import RegularGridInterpolator

from emulator.scene.terrain.box_moments import add_box
from emulator.scene.terrain.tile import MOMENTS, RATES

ROWS, COLUMNS = 23, 31
POINTS = 400  # along each side of a box


@njit
def mean_and_rate(moments, level, box):
    sums = np.zeros(RATES + 3 * MOMENTS, np.float32)
    add_box(moments, level, box, sums, MOMENTS)
    return sums


@pytest.fixture(scope="module")
def posts():
    return np.random.default_rng(3).uniform(-1, 1, (ROWS, COLUMNS, MOMENTS)).astype(np.float16)


def flat(posts):
    padding = np.zeros((16 * (COLUMNS + 1), MOMENTS), np.float16)
    return np.concatenate([posts.reshape(-1, MOMENTS), padding]).reshape(-1).view(np.uint16)


def expected(posts, x, y, half_x, half_y):
    ground = RegularGridInterpolator((np.arange(ROWS), np.arange(COLUMNS)), posts.astype(np.float64))
    within = (np.arange(POINTS) + 0.5) / POINTS * 2 - 1
    ys, xs = np.meshgrid(y + within * half_y, x + within * half_x, indexing="ij")
    return ground((ys, xs)).mean(axis=(0, 1))


@pytest.mark.parametrize("half_x", [0.01, 0.4, 1.37, 2.6, 4.0])
@pytest.mark.parametrize(
    ("x", "y", "half_y"), [(12.3, 9.1, 0.7), (26.0, 18.0, 4.0), (4.0, 4.0, 3.3), (15.5, 11.5, 0.02)]
)
def test_a_mean_is_that_of_ground_linear_between_posts(posts, x, y, half_x, half_y):
    box = tuple(np.float32(v) for v in (x, y, half_x, half_y, 1 / (half_x * half_y), 0.0, 0.0))
    sums = mean_and_rate(flat(posts), (0, COLUMNS, ROWS), box)
    assert not sums[:MOMENTS].any()
    assert not sums[2 * MOMENTS :].any()
    np.testing.assert_allclose(sums[MOMENTS : 2 * MOMENTS], expected(posts, x, y, half_x, half_y), atol=2e-4)


@pytest.mark.parametrize("half_x", [0.01, 1.37, 4.0])
@pytest.mark.parametrize("move", [(1.0, 0.0), (0.0, 1.0), (-30.0, 20.0)])
def test_the_rate_of_a_mean_is_its_change_as_the_box_moves(posts, half_x, move):
    x, y, half_y, moment_s = 12.3, 9.1, 0.7, 1e-4
    box = tuple(np.float32(v) for v in (x, y, half_x, half_y, 1 / (half_x * half_y), *move))
    sums = mean_and_rate(flat(posts), (0, COLUMNS, ROWS), box)
    np.testing.assert_allclose(sums[MOMENTS : 2 * MOMENTS], expected(posts, x, y, half_x, half_y), atol=2e-4)
    later, before = (
        expected(posts, x + sign * moment_s * move[0], y + sign * moment_s * move[1], half_x, half_y)
        for sign in (1, -1)
    )
    rate = (later - before) / (2 * moment_s)
    np.testing.assert_allclose(sums[RATES + MOMENTS : RATES + 2 * MOMENTS], rate, atol=2e-3 * np.abs(move).max())
    assert not sums[2 * MOMENTS : RATES + MOMENTS].any()
