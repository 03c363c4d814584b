"""Means over squares of the map around a pixel's parts, against scipy's interpolation at a great many points."""

from types import SimpleNamespace

import numpy as np
import pytest
from numba import njit
from scipy.interpolate import RegularGridInterpolator

from emulator.scene.terrain.footprint import level_for, means, padded, shorter_side

ROWS, COLUMNS, UNIT_M = 23, 31, 0.5
POINTS = 400  # along each side of a square
SUN, EYE = (0.36, 0.48, 0.8), (-0.6, 0.0, 0.8)


@njit
def measured(posts, levels, level, part, pixel, counts, side):
    at, across, down, lift = pixel
    return means(posts, levels, level, part, UNIT_M, at, across, down, lift, counts, side, SUN, EYE)


@pytest.fixture(scope="module")
def pyramid():
    """Two levels of numbers that have nothing to do with each other, the second one like a level of half the posts."""
    random = np.random.default_rng(3)
    shapes = (ROWS, COLUMNS), (ROWS // 2 + 1, COLUMNS // 2 + 1)
    parts = [random.uniform(-1, 1, (rows * columns, 4)) for rows, columns in shapes]
    levels = np.zeros((2, 9), np.int64)
    levels[:, 1:3] = shapes
    levels[1, 0] = ROWS * COLUMNS
    return SimpleNamespace(posts=np.concatenate(parts).astype(np.float32), levels=levels)


def interpolated(pyramid, level):
    """Return height, b p, b q and b as a function of places (..., 2), y and x in posts."""
    first, rows, columns = pyramid.levels[level, :3]
    posts = pyramid.posts[first : first + rows * columns].reshape(rows, columns, 4).astype(np.float64)
    return RegularGridInterpolator((np.arange(rows), np.arange(columns)), posts)


def expected(pyramid, level, pixel, counts, side):
    ground, per_m = interpolated(pyramid, level), 1 / (UNIT_M * 2**level)
    at, across, down, lift = (np.array(v) for v in pixel)
    within = (np.arange(POINTS) + 0.5) / POINTS - 0.5
    total = np.zeros(4)
    for i in range(counts[1]):
        for j in range(counts[0]):
            place = at + ((j + 0.5) / counts[0] - 0.5) * across + ((i + 0.5) / counts[1] - 0.5) * down
            x, y = met(lambda x, y: ground((y * per_m, x * per_m))[0], place, lift)[:2] * per_m
            ys, xs = np.meshgrid(y + within * side * per_m, x + within * side * per_m, indexing="ij")
            bp, bq, b = ground((ys, xs)).mean(axis=(0, 1))[1:]
            total += b, bp, bq, reflected(bp, bq, b)
    return total / (counts[0] * counts[1])


def met(height, place, lift):
    """Return where a ray that meets a facet at `place` meets the ground, after a secant whose slope is 1/2 to 2."""
    first = height(*place[:2]) - place[2]
    there = place + first * lift
    more = height(*there[:2]) - there[2]
    return place + (first + more * np.clip(first / (first - more), 0.5, 2.0)) * lift


def reflected(bp, bq, b):
    """Return b / (mu0 + mu) of a mean slope, the dark apart."""
    if b <= 0:
        return 0.0
    normal = np.array([-bp, -bq, b]) / np.linalg.norm([bp, bq, b])
    return b / (max(normal @ SUN, 0.0) + max(normal @ EYE, 0.02))


PIXEL = (6.3, 5.1, 0.2), (0.9, 0.1, 0.05), (-0.2, 1.1, -0.1), (0.4, -0.3, 0.5)


@pytest.mark.system
@pytest.mark.parametrize("counts", [(1, 1), (2, 2), (3, 2), (2, 5)])
@pytest.mark.parametrize("side", [0.013, 0.4, 1.37, 1.99])
def test_means_are_those_of_linear_ground_over_squares_at_the_lifted_parts(pyramid, counts, side):
    got = measured(padded(pyramid), pyramid.levels, 0, 0.0, PIXEL, tuple(map(float, counts)), side)
    np.testing.assert_allclose(got, expected(pyramid, 0, PIXEL, counts, side), atol=2e-4)


def test_the_next_level_counts_by_its_part(pyramid):
    got = measured(padded(pyramid), pyramid.levels, 0, 0.3, PIXEL, (2.0, 2.0), 1.2)
    both = [expected(pyramid, level, PIXEL, (2, 2), 1.2) for level in (0, 1)]
    np.testing.assert_allclose(got, 0.7 * both[0] + 0.3 * both[1], atol=2e-4)


@pytest.mark.parametrize("at", [(-5.0, 3.0, 0.0), (1e6, 1e6, 0.0), (15.0, 11.0, -1e4), (0.0, -1e9, 0.0)])
def test_squares_beyond_the_map_are_those_at_its_border(pyramid, at):
    posts = padded(pyramid)
    got = measured(posts, pyramid.levels, 0, 0.0, (at, *PIXEL[1:3], (0.0, 0.0, 1.0)), (1.0, 1.0), 1.0)
    x, y = np.clip(at[0], 0.5, (COLUMNS - 2) / 2), np.clip(at[1], 0.5, (ROWS - 2) / 2)
    here = (float(x), float(y), 0.0), *PIXEL[1:3], (0.0, 0.0, 1.0)
    np.testing.assert_allclose(got, expected(pyramid, 0, here, (1, 1), 1.0), atol=2e-4)


def sloping(heights, b_p=0.0, b=1.0):
    """Return one level of posts from functions of their places, m."""
    y, x = np.mgrid[:ROWS, :COLUMNS] * UNIT_M
    fields = heights(x, y), b_p * np.ones_like(x), np.zeros_like(x), b * np.ones_like(x)
    levels = np.zeros((1, 9), np.int64)
    levels[0, 1:3] = ROWS, COLUMNS
    return SimpleNamespace(posts=np.stack(fields, axis=-1).reshape(-1, 4).astype(np.float32), levels=levels)


@pytest.mark.parametrize("slope", [-0.4, 0.2, 0.45])
def test_a_part_is_where_its_ray_meets_a_slope_that_its_facet_does_not_have(slope):
    """Below a level facet lies z = slope x: the ray x = 7 - s, z = s meets it where x = 7 / (1 + slope)."""
    ground = sloping(lambda x, y: slope * x)
    x = np.mgrid[:ROWS, :COLUMNS][1].reshape(-1) * UNIT_M
    ground.posts[:, 3] = x  # b tells the place
    pixel = (7.0, 5.0, 0.0), (1e-3, 0.0, 0.0), (0.0, 1e-3, 0.0), (-1.0, 0.0, 1.0)
    got = measured(padded(ground), ground.levels, 0, 0.0, pixel, (1.0, 1.0), 0.5)
    assert got[0] == pytest.approx(7.0 / (1 + slope), rel=1e-5)


def test_light_is_the_mean_of_the_law_and_not_the_law_of_the_mean_slope():
    """Half of the pixel slopes up and half of it down by 0.5; b is 1 on both."""
    ground = sloping(lambda x, y: 0 * x)
    x = np.mgrid[:ROWS, :COLUMNS][1].reshape(-1)
    ground.posts[:, 1] = np.where(x < COLUMNS // 2, -0.5, 0.5)
    middle = (COLUMNS // 2 - 0.5) * UNIT_M
    pixel = (middle, 5.0, 0.0), (8 * UNIT_M, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    b, bp, _, got = measured(padded(ground), ground.levels, 0, 0.0, pixel, (2.0, 1.0), UNIT_M)
    assert (b, bp) == pytest.approx((1.0, 0.0), abs=1e-6)
    assert got == pytest.approx((reflected(0.5, 0.0, 1.0) + reflected(-0.5, 0.0, 1.0)) / 2, rel=1e-6)
    assert got > 1.05 * reflected(0.0, 0.0, 1.0)


@njit
def side_of(ax, ay, bx, by, most):
    return shorter_side(ax, ay, bx, by, most)


@pytest.mark.parametrize("most", [1.5, 12.0])
def test_the_shorter_side_is_the_least_singular_value(most):
    for seed in range(20):
        matrix = np.random.default_rng(seed).normal(size=(2, 2))
        longer, shorter = np.linalg.svd(matrix, compute_uv=False)
        got = side_of(matrix[0, 0], matrix[1, 0], matrix[0, 1], matrix[1, 1], most)
        assert got == pytest.approx(max(shorter, longer / most), rel=1e-6)


@njit
def found(size, begin, lowest, top):
    return level_for(size, begin, lowest, top)


@pytest.mark.parametrize("begin", range(8))
def test_the_level_does_not_depend_on_where_the_search_begins(begin):
    for size, lowest, top, level in [(0.1, 0, 6, 0), (1.0, 0, 6, 0), (1.01, 0, 6, 1), (8.0, 1, 6, 3), (999.0, 0, 6, 6)]:
        assert found(size, begin, lowest, top) == level
    assert found(0.1, begin, 2, 6) == 2
    assert found(9.0, begin, 3, 1) == 3
