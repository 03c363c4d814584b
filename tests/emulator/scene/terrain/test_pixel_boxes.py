"""Means of the map's moments over boxes and footprints, against scipy's interpolation and closed forms."""

import numpy as np
import pytest
from numba import njit
from scipy.interpolate import RegularGridInterpolator

from emulator.scene.terrain import tile
from emulator.scene.terrain.box_moments import add_box
from emulator.scene.terrain.pixel_boxes import footprints
from emulator.scene.terrain.pixel_hits import Projection
from emulator.scene.terrain.tile import MOMENTS, RATES, TILE, new_tile

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


@pytest.mark.parametrize("half_x", [0.01, 0.4, 1.37, 2.0])
@pytest.mark.parametrize(
    ("x", "y", "half_y"), [(12.3, 9.1, 0.7), (26.0, 18.0, 2.0), (2.0, 2.0, 1.3), (15.5, 11.5, 0.02)]
)
def test_a_mean_is_that_of_ground_linear_between_posts(posts, x, y, half_x, half_y):
    box = tuple(np.float32(v) for v in (x, y, half_x, half_y, 1 / (half_x * half_y), 0.0, 0.0))
    sums = mean_and_rate(flat(posts), (0, COLUMNS, ROWS), box)
    assert not sums[:MOMENTS].any()
    assert not sums[2 * MOMENTS :].any()
    np.testing.assert_allclose(sums[MOMENTS : 2 * MOMENTS], expected(posts, x, y, half_x, half_y), atol=2e-4)


@pytest.mark.parametrize("half_x", [0.01, 1.37, 2.0])
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


def with_corners(corners):
    """Return a tile whose first pixel has these four hits (2, 2, 3), the others a square."""
    s = new_tile().fields
    square = np.array([[(0, 0, -9), (1, 0, -9)], [(0, -1, -9), (1, -1, -9)]], float)
    for row, fields in ((0, (tile.ABOVE_X, tile.ABOVE_Y, tile.ABOVE_Z)), (1, (tile.X, tile.Y, tile.Z))):
        for axis, field in enumerate(fields):
            s[field * TILE : (field + 1) * TILE + 1] = np.arange(TILE + 1) * (axis == 0) + square[row, 0, axis]
            s[field * TILE : field * TILE + 2] = corners[row, :, axis]
    return s


def boxes_of(corners):
    s = with_corners(corners)
    footprints(0, 0, Projection(1.0, 0.5, 0.5), np.diag([1.0, -1.0, -1.0]), 1.0, s)
    names = "MIDDLE_X", "MIDDLE_Y", "TAPS", "TAP_X", "TAP_Y", "HALF_X", "HALF_Y", "DOUBT"
    return {name: float(s[getattr(tile, name) * TILE]) for name in names}


def parallelogram(a, b):
    a, b = (*a, 0.0), (*b, 0.0)
    first = np.array((0.3, -0.2, -9.0))
    return np.array([[first, first + a], [first + b, first + np.add(a, b)]])


@pytest.mark.parametrize("a", [(1.0, 0.0), (0.9, 0.4), (3.0, -2.0), (0.2, 4.0)])
@pytest.mark.parametrize("b", [(0.0, -1.0), (0.5, -1.2), (-2.0, -2.0)])
def test_boxes_have_the_spread_of_a_footprint(a, b):
    got = boxes_of(parallelogram(a, b))
    n, tap = got["TAPS"], np.array([got["TAP_X"], got["TAP_Y"]])
    line = (n * n - 1) * np.outer(tap, tap)
    spread = np.diag([(2 * got["HALF_X"]) ** 2, (2 * got["HALF_Y"]) ** 2]) + line
    wanted = np.outer(a, a) + np.outer(b, b)
    thin, most = np.linalg.eigvalsh(wanted)
    least = max(thin, most / 144)
    # A box is no thinner than half the footprint; one box has no lean, and few boxes have less than the footprint's.
    np.testing.assert_allclose(np.diag(spread), np.diag(wanted), atol=0.25 * least + 1e-4 * most)
    lean = 0.12 * least if n == 1 else 0.5 * max(most / n**2 - least, 0.0)
    assert abs(spread[0, 1] - wanted[0, 1]) <= lean + 0.5 * (least - thin) + 1e-4 * most
    middle = np.array((0.3, -0.2)) + (np.array(a) + b) / 2
    assert (got["MIDDLE_X"], got["MIDDLE_Y"]) == pytest.approx(tuple(middle), abs=1e-5)
