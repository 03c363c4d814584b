"""Horizons: walls and cones in closed form, grids around grids, and a ray caster."""

import math

import numpy as np
import pytest
import trimesh

from emulator.scene.terrain.ground import build_pyramid, nested, sunlit
from emulator.scene.terrain.relief import make_ridge
from emulator.scene.terrain.table import Ridge
from emulator.scene.terrain.tile import MOMENTS, B
from emulator.scene.terrain.world import horizon_slopes

POSTS = 65


def sunlit_share(slopes, elevation_rad, radius_rad):
    return np.vectorize(sunlit)(1.0, 0.0, (elevation_rad - np.arctan(slopes.astype(float))) / radius_rad)


def wall(side):
    """Return flat ground with a wall 10 m high on one of its sides."""
    heights = np.zeros((POSTS, POSTS))
    heights[{"north": np.s_[60, :], "south": np.s_[4, :], "east": np.s_[:, 60], "west": np.s_[:, 4]}[side]] = 10.0
    return nested(2.0, [heights])


@pytest.mark.parametrize(("side", "azimuth"), [("north", 0.0), ("east", 90.0), ("south", 180.0), ("west", -90.0)])
def test_a_wall_s_horizon_is_its_height_over_its_distance(side, azimuth):
    slopes = horizon_slopes(wall(side), azimuth)[0]
    along = slopes[:, 32] if side in ("north", "south") else slopes[32]
    along = along if side in ("north", "east") else along[::-1]
    distance = 2.0 * (60 - np.arange(60))
    np.testing.assert_allclose(along[:60], 10.0 / distance, rtol=1e-5)
    assert (along[60:] <= 0).all()
    assert along[-1] == -1000  # nothing beyond the map


@pytest.mark.parametrize("azimuth", [0.0, 65.0, 200.0, -80.0])
def test_a_far_mountain_stands_over_a_fine_grid_as_on_one_map(azimuth):
    """The same smooth hills on one fine map, and on a nest of three grids of which the coarser ones hold them."""

    def hills(grid):
        x, y = np.meshgrid(*(2 * [(np.arange(POSTS) - 32.0) * (1 << grid)]))
        return 30 * np.exp(-((x - 70) ** 2 + (y - 60) ** 2) / 900) + 25 * np.exp(-((x + 80) ** 2 + (y + 50) ** 2) / 600)

    nest = nested(1.0, [hills(grid) for grid in range(3)])
    place = np.arange(257) - 128.0
    x, y = np.meshgrid(place, place)
    whole = nested(
        1.0, [30 * np.exp(-((x - 70) ** 2 + (y - 60) ** 2) / 900) + 25 * np.exp(-((x + 80) ** 2 + (y + 50) ** 2) / 600)]
    )
    fine, known = horizon_slopes(nest, azimuth)[0], horizon_slopes(whole, azimuth)[0][96:161, 96:161]
    np.testing.assert_allclose(fine, known, atol=0.005)
    assert known.max() > 0.1


def test_shadows_fall_where_a_ray_caster_says():
    """Rays by trimesh over embree, from every post of a cratered map to the middle of the Sun."""
    pytest.importorskip("embreex", reason="the ray caster of the test group")
    ground = make_ridge(Ridge(size_m=256.0, finest_m=4.0, posts=64, ridge_m=40.0, crater_density=0.2, seed=4))
    azimuth, elevation = math.radians(37.0), math.radians(12.0)
    dark = sunlit_share(horizon_slopes(ground, 37.0), elevation, math.radians(0.2666))[0] < 0.5
    rows, columns = np.mgrid[:65, :65]
    points = np.stack([(columns - 32) * 4.0, (rows - 32) * 4.0, ground.heights_m[0]], axis=-1).reshape(-1, 3)
    low = (rows * 65 + columns)[:-1, :-1].ravel()
    facets = np.concatenate([np.stack([low, low + 1, low + 66], -1), np.stack([low, low + 66, low + 65], -1)])
    mesh = trimesh.Trimesh(points, facets, process=False)
    sun = np.array(
        [math.sin(azimuth) * math.cos(elevation), math.cos(azimuth) * math.cos(elevation), math.sin(elevation)]
    )
    hit = mesh.ray.intersects_any(points + [0, 0, 0.02], np.tile(sun, (len(points), 1))).reshape(65, 65)
    assert 0.1 < hit.mean() < 0.6
    assert (hit != dark).mean() < 0.02  # facets are triangles there; here heights are linear along rows


def test_the_sun_s_disc_rises_over_the_horizon_by_its_area():
    radius = math.radians(0.2666)
    slopes = np.tan(np.array([-radius, 0.0, radius, 2 * radius, -1.0, radius / 2]) + 0.1).astype(np.float32)
    share = sunlit_share(slopes, 0.1, radius)
    x = -0.5
    expected = 0.5 + (x * math.sqrt(1 - x * x) + math.asin(x)) / math.pi
    np.testing.assert_allclose(share, [1, 0.5, 0, 0, 1, expected], atol=1e-3)


@pytest.mark.parametrize("facing", [-0.002, 0.0, 0.003, 0.05])
@pytest.mark.parametrize("radii", [-1.2, -0.9, -0.4, 0.0, 0.7, 1.5])
def test_light_of_a_disc_over_a_horizon_is_that_of_its_points(facing, radii):
    """The cosine of incidence is linear over the disc; points below the horizon send nothing."""
    y, x = np.meshgrid(*[(np.arange(1500) + 0.5) / 750 - 1] * 2, indexing="ij")
    on_disc = x * x + y * y < 1
    cosines = np.where(y > -radii, facing + 0.00465 * y, 0.0)[on_disc]
    assert sunlit(facing, 0.00465, radii) == pytest.approx(max(cosines.mean(), 0.0), abs=2e-6)


def test_a_rock_s_penumbra_is_as_wide_as_the_reference_says():
    """A 10 m rock under a Sun 2 degrees high: the shadow ends some 286 m away, its edge is about 78 m wide."""
    heights = np.zeros((3, 1001))
    heights[:, 900] = 10.0
    share = sunlit_share(horizon_slopes(nested(1.0, [heights]), 90.0), math.radians(2.0), math.radians(0.2666))[0, 1]
    inside = np.flatnonzero((share > 0) & (share < 1) & (np.arange(1001) < 880))
    assert 900 - np.flatnonzero(share > 0.5)[np.flatnonzero(share > 0.5) < 880].max() == pytest.approx(286, abs=2)
    assert np.ptp(inside) == pytest.approx(
        10 / math.tan(math.radians(1.7334)) - 10 / math.tan(math.radians(2.2666)), abs=3
    )


@pytest.mark.parametrize("edge", [20.0, 20.2, 20.5, 20.7, 20.9])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_shadow_s_edge_between_posts_is_where_the_sun_crosses_the_horizon(edge, axis):
    """Level ground, lit beyond a straight edge with a penumbra of one post: the lit posts have its sunlight in all."""
    ground, sun = nested(1.0, [np.zeros((41, 41))]), np.array([[0.6, 0.0, 0.8], [0.0, 0.0, 0.0]])
    place = np.arange(41.0)[:, None] if axis == 0 else np.arange(41.0)
    radii = np.broadcast_to(2 * (place - edge), (41, 41)).astype(np.float32)
    b = build_pyramid(ground, radii[None], sun, 1).moments.view(np.float16)[B : 41 * 41 * MOMENTS : MOMENTS]
    profile = b.reshape(41, 41).astype(float)[:, 5] if axis == 0 else b.reshape(41, 41).astype(float)[5]
    assert (profile[:-1].sum() + 0.5 * profile[-1]) / 0.8 == pytest.approx(40 - edge, abs=0.02)
    assert profile[: int(edge) - 1] == pytest.approx(0, abs=1e-3)
    assert profile[int(edge) + 3 :] == pytest.approx(0.8, abs=1e-3)
