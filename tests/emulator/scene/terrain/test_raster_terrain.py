"""Ground drawn by the CPU: against point samples of every facet, its rate, threads, levels, and hostile views."""

import dataclasses

import numpy as np
import pytest

from emulator.geometry.camera import Pinhole
from emulator.photometry.reflectance import Hapke, Lambert
from emulator.raster.layout import FACET_FIELDS, W, WHighest, WLowest
from emulator.scene.terrain import tile, world
from emulator.scene.terrain.ground import build_pyramid
from emulator.scene.terrain.pixel_hits import Projection, Sight
from emulator.scene.terrain.pixel_law import Motion, rate_of_doubtful
from emulator.scene.terrain.pixel_parts import first_hits
from emulator.scene.terrain.raster_terrain import RasterTerrain
from emulator.scene.terrain.relief import make_ridge
from emulator.scene.terrain.table import Heightmap, Ridge, TerrainParameters
from emulator.scene.terrain.tile import FIELDS, MOMENTS, TILE, new_tile
from emulator.scene.terrain.world import TerrainWorld
from emulator.trajectory.laws import Gate
from emulator.trajectory.parameters import DescentPath, FixedPath, Keyframe, KeyframePath
from laboratory.accuracy.sampled_scenes import SampledTerrain

CAMERA = Pinhole.of_field((96, 64), 60.0)
DOWN = (0.0, 1.0, 0.0, 0.0)
RIDGE = Ridge(size_m=1024.0, finest_m=2.0, posts=128, ridge_m=100.0, seed=4)  # its site is in sunlight
DOWNWARD = DescentPath((Gate(0.0, 400.0, 0.0, 10.0, 50.0), Gate(60.0, 30.0, 0.0, 3.0, 80.0), Gate(70.0, 8.0)))


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


def parameters(**changes):
    plain = TerrainParameters(ground=RIDGE, camera=DOWNWARD, sun_elevation_deg=20.0)
    return dataclasses.replace(plain, **changes)


def looked_at(p, t_ns, camera=CAMERA, threads=1):
    light = np.full(camera.size[::-1], np.nan, np.float32)
    with RasterTerrain(p, camera, threads) as scene:
        scene.light(t_ns, light)
    return light


def sampled(p, t_ns, camera=CAMERA, samples=16):
    light = np.zeros(camera.size[::-1], np.float32)
    with SampledTerrain(p, camera, samples) as scene:
        scene.light(t_ns, light)
    return light


@pytest.mark.system
@pytest.mark.parametrize(("t_s", "median"), [(5, 4e-3), (40, 4e-3), (65, 1.2e-2)])
@pytest.mark.parametrize("law", [Lambert(0.3), Hapke()])
def test_light_is_that_of_every_facet_sampled(t_s, median, law):
    """Far away coarse blocks and filtered levels differ.

    Near by, where posts are many pixels apart, it is what lies between posts: here the law of mean normals, there the
    mean of the law's values.
    """
    p = parameters(reflectance=law)
    light, truth = looked_at(p, t_s * 10**9), sampled(p, t_s * 10**9, samples=8)
    errors = np.abs(light - truth) / truth.mean()
    assert np.median(errors) < median
    assert np.percentile(errors, 99) < 0.12
    assert abs(light.mean() / truth.mean() - 1) < median


def with_rate(p, t_ns, threads=1):
    light, rate = (np.full(CAMERA.size[::-1], np.nan, np.float32) for _ in range(2))
    with RasterTerrain(p, CAMERA, threads) as scene:
        scene.light_and_rate(t_ns, light, rate)
    return light, rate


def difference(p, t_ns, side_ns=20_000_000):
    """Return the rate over a time in which the change is far above rounding."""
    return (looked_at(p, t_ns + side_ns) - looked_at(p, t_ns - side_ns)).astype(np.float64) / (2e-9 * side_ns)


@pytest.mark.sampled
@pytest.mark.parametrize(("t_s", "median", "p90"), [(5, 0.02, 0.1), (40, 0.02, 0.1), (65, 0.08, 0.2)])
@pytest.mark.parametrize("law", [Lambert(0.3), Hapke()])
def test_the_rate_is_the_change_of_light(t_s, median, p90, law):
    """Facets that give way to others make the light jump in some pixels, but not the rate; at 65 s little moves."""
    p = parameters(reflectance=law)
    _, rate = with_rate(p, t_s * 10**9)
    change = difference(p, t_s * 10**9)
    errors, middle = np.abs(rate - change), np.median(np.abs(change))
    assert np.median(errors) < median * middle
    assert np.percentile(errors, 90) < p90 * middle


def test_a_plane_s_rate_is_that_of_the_turning_view(tmp_path):
    """The camera stands still and turns: light changes with the direction of view alone."""
    np.save(tmp_path / "plane.npy", np.zeros((257, 257)))
    flat = Heightmap(path=str(tmp_path / "plane.npy"), post_m=2.0)
    half = np.radians(10.0) / 2
    turned = (0.0, float(np.cos(half)), float(np.sin(half)), 0.0)
    path = KeyframePath((Keyframe(0.0, (0.0, 0.0, 150.0), DOWN), Keyframe(1.0, (0.0, 0.0, 150.0), turned)))
    p = parameters(ground=flat, camera=path, body_radius_m=0.0, reflectance=Hapke())
    light, rate = with_rate(p, 500_000_000)
    change = difference(p, 500_000_000)
    assert np.abs(change).max() > 1e-2 * light.mean()
    np.testing.assert_allclose(rate, change, atol=0.02 * np.abs(change).max())


@pytest.fixture
def computed(tmp_path, monkeypatch):
    """Return a list that gets an item for each computation of a ground's light; the cache is empty and for all maps."""
    calls, build = [], world.build_pyramid
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "empty"))
    monkeypatch.setattr(world, "_CACHED_POSTS", 0)
    monkeypatch.setattr(world, "build_pyramid", lambda *inputs: calls.append(1) or build(*inputs))
    return calls


def test_light_from_the_cache_is_the_computed_one_to_the_last_bit(computed, tmp_path):
    first = with_rate(parameters(), 10**10)
    np.testing.assert_array_equal(with_rate(parameters(), 10**10), first)
    assert len(computed) == 1
    for path in (tmp_path / "empty" / "evstim").glob("light-1-*"):
        path.write_bytes(path.read_bytes()[:-100])
    np.testing.assert_array_equal(with_rate(parameters(), 10**10), first)
    assert len(computed) == 2


@pytest.mark.parametrize(
    "changes",
    [
        {"sun_azimuth_deg": 61.0},
        {"sun_elevation_deg": 20.5},
        {"sun_distance_au": 1.1},
        {"body_radius_m": 1e6},
        {"ground": dataclasses.replace(RIDGE, seed=5)},
        {"ground": dataclasses.replace(RIDGE, albedo_rms=0.2)},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_light_of_another_sun_or_ground_is_computed_anew(computed, changes):
    with_rate(parameters(), 10**10)
    light, rate = with_rate(parameters(**changes), 10**10)
    assert len(computed) == 2
    np.testing.assert_array_equal(with_rate(parameters(**changes), 10**10), (light, rate))


def test_light_of_other_sources_is_computed_anew(computed, monkeypatch):
    for checksum in (1, 2, 2):
        monkeypatch.setattr(world, "checksum_of", lambda _, checksum=checksum: checksum)
        looked_at(parameters(), 10**10)
    assert len(computed) == 2


def test_light_is_the_same_with_its_rate():
    p = parameters()
    np.testing.assert_array_equal(with_rate(p, 10**10)[0], looked_at(p, 10**10))


SCREEN = Projection(40.0, 20.0, 10.0)


def rate_by_gradient(light, motion, inverse_depth=0.1, doubtful=1):
    facets = np.zeros((1, FACET_FIELDS))
    facets[0, [W, WLowest, WHighest]] = inverse_depth
    rate = np.full(light.shape, np.nan, np.float32)
    sight = Sight(np.zeros(light.shape, np.int32), facets, SCREEN, np.zeros(3), np.eye(3))
    doubtful = np.full(light.shape, doubtful, np.uint8)
    rate_of_doubtful((0, len(light)), sight, Motion(*motion), doubtful, light.astype(np.float32), rate)
    return rate


@pytest.mark.parametrize(
    ("motion", "flow"),
    [
        ((np.zeros((3, 3)), np.array([3.0, -2.0, 0.0])), lambda x, y: (12.0 + 0 * x, -8.0 + 0 * x)),
        ((np.zeros((3, 3)), np.array([0.0, 0.0, -4.0])), lambda x, y: (0.4 * x, 0.4 * y)),
        ((np.array([[0, -0.5, 0], [0.5, 0, 0], [0, 0, 0.0]]), np.zeros(3)), lambda x, y: (-0.5 * y, 0.5 * x)),
    ],
    ids=["aside", "ahead", "roll"],
)
def test_light_that_goes_with_the_ground_has_the_rate_of_its_gradient(motion, flow):
    y, x = np.mgrid[:20, :40] + 0.5
    light = 5 + np.sin(0.9 * x + 0.2) * np.cos(0.7 * y)
    across, down = 0.9 * np.cos(0.9 * x + 0.2) * np.cos(0.7 * y), -0.7 * np.sin(0.9 * x + 0.2) * np.sin(0.7 * y)
    u, v = flow(x - SCREEN[1], y - SCREEN[2])
    inner = np.s_[3:-3, 3:-3]
    rate = rate_by_gradient(light, motion)[inner]
    np.testing.assert_allclose(rate, -(u * across + v * down)[inner], atol=0.06)


def test_light_where_a_shadow_ends_is_that_of_the_horizon_between_posts(tmp_path, monkeypatch):
    """A plane from straight above, 2.6 posts a pixel; the Sun sinks by 3 radii a post across a wavy border."""
    np.save(tmp_path / "plane.npy", np.zeros((257, 257)))

    def radii_at(east, north):
        return 3 * (east - 0.4 - 3 * np.sin(north / 9))

    posts = np.arange(-128.0, 129.0)
    radii = radii_at(posts, posts[:, None]).astype(np.float32)
    monkeypatch.setattr(TerrainWorld, "sun_radii", lambda world: radii[None])
    height = 2.6 * CAMERA.focal_px
    p = parameters(
        ground=Heightmap(path=str(tmp_path / "plane.npy"), post_m=1.0), body_radius_m=0.0, ambient_w_m2=0.0,
        camera=FixedPath((0.0, 0.0, height), DOWN), reflectance=Lambert(1.0), sun_elevation_deg=60.0,
    )  # fmt: skip
    light = looked_at(p, 0)
    places = (np.arange(16) + 0.5) / 16
    right = (np.arange(CAMERA.width)[:, None] + places - CAMERA.width / 2) * 2.6
    down = (np.arange(CAMERA.height)[:, None] + places - CAMERA.height / 2) * 2.6
    above = np.clip(radii_at(right, -down[:, :, None, None]), -1, 1)
    share = 0.5 + (above * np.sqrt(1 - above**2) + np.arcsin(above)) / np.pi
    edge = (share.min(axis=(1, 3)) < 0.9) & (share.max(axis=(1, 3)) > 0.1)
    errors = np.abs(light / np.median(light[:, -10:]) - share.mean(axis=(1, 3)))[edge]
    assert len(errors) > 60
    assert errors.mean() < 0.004
    assert errors.max() < 0.015


def test_light_at_outlines_is_that_of_rays():
    """Over crests: facets of some pixels have other outlines than the map, and change places as the camera moves."""
    rough = dataclasses.replace(RIDGE, crater_density=0.2)
    p = parameters(ground=rough, camera=FixedPath((0.0, -300.0, 140.0), look_at_m=(0.0, 0.0, 90.0)), most_facets=2000)
    truth = sampled(p, 0)
    with RasterTerrain(p, CAMERA) as scene:
        light = np.zeros_like(truth)
        scene.light(0, light)
        outlines = scene._owners.coverage < 1
    assert outlines.sum() > 50
    errors = np.abs(light - truth)[outlines] / truth.mean()
    assert errors.mean() < 0.12
    assert np.isfinite(light).all()
    assert (light >= 0).all()


@pytest.mark.parametrize("upwards", [True, False])
def test_a_ray_that_begins_near_the_hit_of_the_one_before_finds_its_own_first_hit(upwards):
    """Rays in an upright plane over rough ground; downwards they begin below the ground, and then at the start."""
    rough = dataclasses.replace(RIDGE, crater_density=0.2)
    with RasterTerrain(parameters(ground=rough), CAMERA) as scene:
        posts, peaks = scene._posts, scene._peaks
    heights = np.linspace(-0.6, 0.02, TILE)[:: 1 if upwards else -1]
    hits = []
    for begins_there in (0, 1):
        s = new_tile().fields[: FIELDS * TILE].reshape(FIELDS, TILE)
        s[[tile.X, tile.Y, tile.Z, tile.LIFTED]] = 0.1 * np.ones(TILE), np.ones(TILE), heights, 5.0 * np.ones(TILE)
        s[tile.NEXT] = begins_there
        first_hits(TILE, posts, peaks, np.array([3.7, -300.0, 120.0]), s.reshape(-1))
        hits.append(s[[tile.Y, tile.TAPS]])
    assert np.unique(hits[0][0]).size > TILE / 2
    np.testing.assert_allclose(hits[1], hits[0], rtol=1e-6)


@pytest.mark.system
def test_light_goes_on_where_blocks_change():
    """All the way down three pictures 2 ms apart lie on a line: levels pass into each other unseen."""
    p, step_ns = parameters(sun_elevation_deg=60.0, reflectance=Lambert(1.0)), 2_000_000
    with RasterTerrain(p, CAMERA) as scene:
        chosen = set()
        for k in range(150):
            pictures = [np.zeros(CAMERA.size[::-1], np.float32) for _ in range(3)]
            for i, picture in enumerate(pictures):
                scene.light(round(30e9) + k * 200_000_000 + i * step_ns, picture)
            first, second, third = (picture.astype(np.float64) for picture in pictures)
            steepest = np.maximum(np.abs(second - first), np.abs(third - second))
            beyond = np.minimum(np.abs(first - 2 * second + third), steepest) / first.mean()
            assert np.percentile(beyond, 99) < 2e-3
            assert (beyond > 0.02).sum() <= 3  # where a facet gives way to another, fine heights are found from it anew
            assert beyond.max() < 0.2
            chosen.add(len(scene._renderer.topology.faces))
    assert len(chosen) > 5  # blocks did change


def test_threads_draw_the_same_to_the_last_bit():
    p = parameters()
    one = looked_at(p, 10**10)
    for threads in (2, 3):
        np.testing.assert_array_equal(one, looked_at(p, 10**10, threads=threads))
    _, rate = with_rate(p, 10**10)
    np.testing.assert_array_equal(rate, with_rate(p, 10**10, threads=3)[1])


def light_at_one_au(p):
    with RasterTerrain(p, CAMERA) as scene:
        return scene._world.irradiance_w_m2


def test_levels_have_the_ground_s_heights_and_keep_means():
    ground = make_ridge(RIDGE)
    sun = np.array([[0.6, 0.0, 0.8], [0.0, 0.0, 0.0]])
    pyramid = build_pyramid(ground, np.ones_like(ground.heights_m), sun, ground.grids + 3)
    moments = pyramid.moments.view(np.float16).reshape(-1, MOMENTS).astype(np.float64)
    coarser = None
    for level in range(ground.grids + 3):
        offset, rows, columns = pyramid.levels[level, :3]
        heights = pyramid.heights[offset : offset + rows * columns].reshape(rows, columns)
        posts = moments[offset : offset + rows * columns].reshape(rows, columns, MOMENTS)
        stride = 1 << max(level - ground.grids + 1, 0)
        np.testing.assert_array_equal(heights, ground.heights_m[min(level, ground.grids - 1), ::stride, ::stride])
        inner = posts[rows // 4 : 3 * rows // 4, columns // 4 : 3 * columns // 4]
        if level >= ground.grids:
            np.testing.assert_allclose(inner.mean(axis=(0, 1)), coarser, atol=0.02)
        coarser = inner.mean(axis=(0, 1))


def test_light_of_a_plane_is_its_law_of_reflection(tmp_path):
    """A slope of 0.2 to the east; the Sun in the east, the eye straight above its middle."""
    x = np.arange(257) * 2.0
    np.save(tmp_path / "plane.npy", np.broadcast_to(0.2 * x, (257, 257)).copy())
    plane = Heightmap(path=str(tmp_path / "plane.npy"), post_m=2.0)
    above = FixedPath((0.0, 0.0, 150.0), DOWN)
    p = parameters(ground=plane, camera=above, body_radius_m=0.0, sun_azimuth_deg=90.0, ambient_w_m2=0.0)
    law = Hapke()
    light = looked_at(dataclasses.replace(p, reflectance=law), 0)
    normal = np.array([-0.2, 0.0, 1.0]) / np.hypot(0.2, 1.0)
    sun = np.array([np.cos(np.radians(20.0)), 0.0, np.sin(np.radians(20.0))])
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    right, down = (columns - CAMERA.width / 2) / CAMERA.focal_px, (rows - CAMERA.height / 2) / CAMERA.focal_px
    eye = -np.stack([right, -down, -np.ones_like(right)], axis=-1)
    eye /= np.linalg.norm(eye, axis=-1, keepdims=True)
    irradiance = light_at_one_au(p)
    wanted = irradiance * law.reflect(normal @ sun, eye @ normal, np.arccos(eye @ sun))
    np.testing.assert_allclose(light, wanted, rtol=2e-3)


@pytest.mark.parametrize(
    "path",
    [
        FixedPath((0.0, 0.0, 50.0), look_at_m=(0.0, 0.0, 500.0)),
        FixedPath((0.0, 50_000.0, 300.0), look_at_m=(0.0, 60_000.0, 300.0)),
    ],
    ids=["up", "away"],
)
def test_a_view_without_ground_is_black_and_told(path):
    with RasterTerrain(parameters(camera=path), CAMERA) as scene:
        assert "black" in scene.notes[-1]
    assert not looked_at(parameters(camera=path), 0).any()


def test_ground_behind_the_camera_is_cut_off():
    """Two metres above the ground on coarse posts, the horizon in the middle: facets begin behind the camera."""
    path = KeyframePath((Keyframe(0.0, (0.0, 0.0, 152.0)), Keyframe(1.0, (0.0, 0.5, 152.0))), (0.0, 400.0, 100.0))
    ground = dataclasses.replace(RIDGE, ridge_m=0.0, finest_m=8.0)
    light = looked_at(parameters(camera=path, ground=ground), 500_000_000)
    assert np.isfinite(light).all()
    assert (light[-4:] > 0).all()


def test_a_map_of_any_size_is_drawn_to_its_edge(tmp_path):
    np.save(tmp_path / "odd.npy", np.zeros((43, 71)))
    flat = Heightmap(path=str(tmp_path / "odd.npy"), post_m=4.0)
    p = parameters(ground=flat, camera=FixedPath((0.0, 0.0, 400.0), DOWN), body_radius_m=0.0, ambient_w_m2=10.0)
    light = looked_at(p, 0)
    covered = (light > 0).sum() / (70 * 42 * (4.0 * CAMERA.focal_px / 400.0) ** 2)
    assert 1 <= covered < 1.08  # pixels that the edge passes count whole


def test_the_part_of_the_picture_that_changed_holds_the_ground():
    p = parameters(camera=FixedPath((0.0, 0.0, 50.0), look_at_m=(0.0, 500.0, 50.0)))
    light = np.zeros(CAMERA.size[::-1], np.float32)
    with RasterTerrain(p, CAMERA) as scene:
        scene.light(0, light)
        assert scene.changed is None
        scene.light(1_000_000, light)
        region = scene.changed
    rows = np.flatnonzero(light.any(axis=1))
    assert region.first_row <= rows.min()
    assert region.last_row > rows.max()
