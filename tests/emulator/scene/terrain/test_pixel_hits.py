"""Places where rays meet the map, in closed form: planes, and a ridge before the facet."""

import numpy as np
import pytest

from emulator.scene.terrain import tile
from emulator.scene.terrain.pixel_hits import Fields, Grids, Posts, clamp, meet_first, meet_map, write_levels
from emulator.scene.terrain.tile import TILE, new_tile

POSTS = 41
EYE_M = 1.0  # above the plane of the facet, at x = 0; rays descend by 0.1


def level_of(columns, rows):
    levels = np.zeros((2, 9), np.int64)
    levels[0, 1:7] = rows, columns, -(columns // 2), -(rows // 2), columns - 1, rows - 1
    return levels


def met(heights, meet, start=10.0, reach=1.0):
    """Return x and z of the hit of the ray z = 1 - x / 10 from the facet z = 0, relative to the eye."""
    rows, columns = heights.shape
    s, places, _, _ = new_tile()
    s[tile.X * TILE : (tile.X + 1) * TILE] = start
    s[tile.Z * TILE : (tile.Z + 1) * TILE] = -EYE_M
    s[tile.LIFT_X * TILE : (tile.LIFT_X + 1) * TILE] = -10.0
    s[tile.LIFT_Z * TILE : (tile.LIFT_Z + 1) * TILE] = 1.0
    s[tile.REACH * TILE : (tile.REACH + 1) * TILE] = reach
    s[tile.SIZE * TILE : (tile.SIZE + 1) * TILE] = 0.5
    eye = np.array([0.0, 0.0, EYE_M])
    posts = Posts(heights, np.zeros(0, np.uint16), level_of(columns, rows), Grids(1.0, 1, columns // 2))
    write_levels(TILE, posts, 0, eye, Fields(tile.X, tile.Y, tile.SIZE), s, places)
    meet(heights.ravel().astype(np.float32), np.float32(EYE_M), s, places)
    x, z = (s[field * TILE : (field + 1) * TILE] for field in (tile.X, tile.Z))
    assert (x == x[0]).all()
    return float(x[0]), float(z[0]) + EYE_M


def along_x(height):
    """Return heights by a function of x, posts a metre apart, x = 0 in the middle."""
    return np.broadcast_to(height(np.arange(POSTS) - POSTS // 2), (POSTS, POSTS)).copy()


@pytest.mark.parametrize("meet", [meet_map, meet_first])
@pytest.mark.parametrize("slope", [-0.04, 0.0, 0.03])
def test_a_ray_meets_a_slope_that_its_facet_does_not_have(meet, slope):
    """Ground z = slope x: 1 - x / 10 = slope x."""
    wanted = 1.0 / (0.1 + slope)
    assert met(along_x(lambda x: slope * x), meet) == pytest.approx((wanted, slope * wanted), abs=1e-4)


def test_a_ridge_before_the_facet_hides_it():
    """A ridge 0.8 high at x = 6, two metres wide: 1 - x / 10 = 0.8 (x - 5) at x = 5 / 0.9."""
    ridge = along_x(lambda x: np.maximum(0.8 * (1 - abs(x - 6)), 0.0))
    x, z = met(ridge, meet_first)
    assert x == pytest.approx(5 / 0.9, abs=0.05)
    assert z == pytest.approx(1 - x / 10, abs=1e-4)
    assert met(ridge, meet_map)[0] == pytest.approx(10.0, abs=1e-4)


def test_beyond_the_reach_the_facet_is_met():
    ridge = along_x(lambda x: np.maximum(0.8 * (1 - abs(x - 6)), 0.0))
    assert met(ridge, meet_first, reach=0.1)[0] == pytest.approx(10.0, abs=1e-3)


def test_no_number_is_the_lowest_place():
    assert clamp.py_func(float("nan"), 0.0, 5.0) == 0.0
    assert [clamp.py_func(v, 0.0, 5.0) for v in (-1.0, 3.0, 9.0)] == [0.0, 3.0, 5.0]
