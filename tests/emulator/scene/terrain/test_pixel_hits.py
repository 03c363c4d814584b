"""Places where rays meet the map, in closed form: planes, and a ridge before the facet."""

import numpy as np
import pytest

from emulator.scene.terrain import tile
from emulator.scene.terrain.ground import nested
from emulator.scene.terrain.pixel_hits import Fields, Grids, Posts, meet_map, write_levels
from emulator.scene.terrain.pixel_parts import Peaks, first_hits
from emulator.scene.terrain.quadtree import Quadtree
from emulator.scene.terrain.relief import make_ridge
from emulator.scene.terrain.table import Ridge
from emulator.scene.terrain.tile import TILE, new_tile

POSTS = 41
NONE = np.zeros(0, np.uint16)
EYE_M = 1.0  # above the plane of the facet, at x = 0; rays descend by 0.1


def level_of(columns, rows):
    levels = np.zeros((2, 9), np.int64)
    levels[0, 1:7] = rows, columns, -(columns // 2), -(rows // 2), columns - 1, rows - 1
    return levels


def met(heights, start=10.0):
    """Return x and z of the hit of the ray z = 1 - x / 10 from the facet z = 0, relative to the eye."""
    rows, columns = heights.shape
    s, places, _, _ = new_tile()
    s[tile.X * TILE : (tile.X + 1) * TILE] = start
    s[tile.Z * TILE : (tile.Z + 1) * TILE] = -EYE_M
    s[tile.LIFT_X * TILE : (tile.LIFT_X + 1) * TILE] = -10.0
    s[tile.LIFT_Z * TILE : (tile.LIFT_Z + 1) * TILE] = 1.0
    s[tile.SIZE * TILE : (tile.SIZE + 1) * TILE] = 0.5
    eye = np.array([0.0, 0.0, EYE_M])
    posts = Posts(heights, NONE, level_of(columns, rows), Grids(1.0, 1, columns // 2), NONE)
    write_levels(TILE, posts, 0, eye, Fields(tile.X, tile.Y, tile.SIZE), s, places)
    meet_map(heights.ravel().astype(np.float32), np.float32(EYE_M), s, places)
    x, z = (s[field * TILE : (field + 1) * TILE] for field in (tile.X, tile.Z))
    assert (x == x[0]).all()
    return float(x[0]), float(z[0]) + EYE_M


def along_x(height):
    """Return heights by a function of x, posts a metre apart, x = 0 in the middle."""
    return np.broadcast_to(height(np.arange(POSTS) - POSTS // 2), (POSTS, POSTS)).copy()


def first_met(ground, eye, rays, start=0.0):
    """Return the places where rays from `eye`, (n, 3) each, first meet a ground, and the ways there; inf for none."""
    tree, count = Quadtree(ground, 100.0), len(rays)
    levels = np.zeros((ground.grids, 9), np.int64)
    for grid in range(ground.grids):
        rows, columns = ground.shape
        spans = (columns - 1) << grid, (rows - 1) << grid
        levels[grid, :7] = grid * rows * columns, rows, columns, *ground.first(grid), *spans
    posts = Posts(ground.heights_m.ravel(), NONE, levels, Grids(ground.unit_m, ground.grids, 1.0), NONE)
    places, ways = np.full((count, 3), np.inf), np.full(count, np.inf)
    for k in range(0, count, TILE):
        some = rays[k : k + TILE].astype(np.float32)
        s = new_tile().fields
        for axis, field in enumerate((tile.X, tile.Y, tile.Z)):
            s[field * TILE : field * TILE + len(some)] = some[:, axis]
        s[tile.LIFTED * TILE : (tile.LIFTED + 1) * TILE] = start
        s[tile.SIZE * TILE : (tile.SIZE + 1) * TILE] = 1.0
        first_hits(len(some), posts, Peaks(tree.highest, tree.levels), np.asarray(eye, float), s)
        hit = s[tile.TAPS * TILE : tile.TAPS * TILE + len(some)] > 0
        at = np.stack([s[field * TILE : field * TILE + len(some)] for field in (tile.X, tile.Y, tile.Z)], axis=1)
        places[k : k + TILE][hit] = at[hit] + eye
        ways[k : k + TILE][hit] = (np.linalg.norm(at, axis=1) / np.linalg.norm(some, axis=1))[hit]
    return places, ways


@pytest.mark.long
@pytest.mark.parametrize("slope", [-0.04, 0.0, 0.03])
def test_a_ray_meets_a_slope_that_its_facet_does_not_have(slope):
    """Ground z = slope x: 1 - x / 10 = slope x."""
    wanted = 1.0 / (0.1 + slope)
    assert met(along_x(lambda x: slope * x)) == pytest.approx((wanted, slope * wanted), abs=1e-4)
    (place,), _ = first_met(nested(1.0, [along_x(lambda x: slope * x)]), [0, 0.3, 1.0], np.array([[10.0, 0, -1.0]]))
    assert place[[0, 2]] == pytest.approx((wanted, slope * wanted), abs=1e-4)


@pytest.mark.long
def test_a_ridge_before_the_facet_hides_it():
    """A ridge 0.8 high at x = 6, two metres wide: 1 - x / 10 = 0.8 (x - 5) at x = 5 / 0.9."""
    ridge = along_x(lambda x: np.maximum(0.8 * (1 - abs(x - 6)), 0.0))
    ground, ray = nested(1.0, [ridge]), np.array([[10.0, 0, -1.0]])
    for start in (0.0, 0.3, 0.58):  # the last one begins inside the ridge
        (place,), _ = first_met(ground, [0, 0.3, 1.0], ray, start)
        assert place[0] == pytest.approx(5 / 0.9, abs=1e-4)
        assert place[2] == pytest.approx(1 - place[0] / 10, abs=1e-4)
    assert first_met(ground, [0, 0.3, 1.0], ray, 0.8)[0][0, 0] == pytest.approx(10.0, abs=1e-4)
    assert met(ridge)[0] == pytest.approx(10.0, abs=1e-4)


@pytest.mark.long
def test_rays_meet_nested_grids_where_small_steps_do():
    """Rays that graze a cratered map of three grids, beside heights at steps of a twentieth of the finest posts."""
    ground = make_ridge(Ridge(size_m=256.0, finest_m=1.0, posts=64, ridge_m=40.0, crater_density=0.2, seed=4))
    assert ground.grids == 3
    eye, rng = np.array([3.0, -70.0, ground.height_m(3.0, -70.0) + 20.0]), np.random.default_rng(5)
    turn, fall = rng.uniform(-0.6, 0.6, 300), rng.uniform(-0.3, 0.3, 300)
    rays = np.stack([np.sin(turn), np.cos(turn), -fall], axis=1).astype(np.float32).astype(float)
    _, ways = first_met(ground, eye, rays)
    for ray, way in zip(rays, ways, strict=True):
        along, height = 0.0, -np.inf
        while height is not None and eye[2] + along * ray[2] > height:
            along += 0.05
            height = ground.height_m(*(eye[:2] + along * ray[:2]))
        assert (way == np.inf) == (height is None)
        assert height is None or along - 0.0501 <= way <= along + 1e-3
    assert 30 < np.isfinite(ways).sum() < 290
