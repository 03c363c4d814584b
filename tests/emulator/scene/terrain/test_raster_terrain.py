"""Ground drawn by the CPU: against point samples of every facet, its rate, threads, levels, and hostile views."""

import dataclasses

import numpy as np
import pytest

from emulator.accuracy.sampled_terrain import SampledTerrain
from emulator.geometry.pinhole import Pinhole
from emulator.photometry.reflectance import Hapke, Lambert
from emulator.scene.terrain.pyramid import build_pyramid
from emulator.scene.terrain.raster_terrain import RasterTerrain
from emulator.scene.terrain.relief import make_ridge
from emulator.scene.terrain.table import Heightmap, Ridge, TerrainParameters
from emulator.trajectory.descent import Gate
from emulator.trajectory.parameters import DescentPath, FixedPath, Keyframe, KeyframePath

CAMERA = Pinhole.of_field((96, 64), 60.0)
DOWN = (0.0, 1.0, 0.0, 0.0)
RIDGE = Ridge(size_m=1024.0, finest_m=2.0, posts=128, ridge_m=100.0, seed=2)
DOWNWARD = DescentPath((Gate(0.0, 400.0, 0.0, 10.0, 50.0), Gate(60.0, 30.0, 0.0, 3.0, 80.0), Gate(70.0, 8.0)))


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


def parameters(**changes):
    plain = TerrainParameters(ground=RIDGE, camera=DOWNWARD, sun_elevation_deg=20.0)
    return dataclasses.replace(plain, **changes)


def looked_at(p, t_ns, camera=CAMERA, threads=1):
    light, rate = (np.full(camera.size[::-1], np.nan, np.float32) for _ in range(2))
    with RasterTerrain(p, camera, threads) as scene:
        scene.light_and_rate(t_ns, light, rate)
    return light, rate


@pytest.mark.parametrize(("t_s", "median"), [(5, 4e-3), (40, 4e-3), (65, 1.2e-2)])
@pytest.mark.parametrize("law", [Lambert(0.3), Hapke()])
def test_light_is_that_of_every_facet_sampled(t_s, median, law):
    """Far away coarse blocks and filtered levels differ.

    Near by, where posts are many pixels apart, it is what lies between posts: here the law of mean normals, there the
    mean of the law's values.
    """
    p = parameters(reflectance=law)
    light, _ = looked_at(p, t_s * 10**9)
    truth = np.zeros_like(light)
    with SampledTerrain(p, CAMERA, 8) as reference:
        reference.light(t_s * 10**9, truth)
    errors = np.abs(light - truth) / truth.mean()
    assert np.median(errors) < median
    assert np.percentile(errors, 99) < 0.12
    assert abs(light.mean() / truth.mean() - 1) < median


@pytest.mark.parametrize("t_s", [5, 40, 65])
def test_the_rate_is_the_slope_of_the_light(t_s):
    p, around_ns = parameters(), 100_000
    before, after = (looked_at(p, t_s * 10**9 + k * around_ns)[0].astype(np.float64) for k in (-1, 1))
    _, rate = looked_at(p, t_s * 10**9)
    slope = (after - before) / (2e-9 * around_ns)
    errors = np.abs(rate - slope) / np.sqrt(np.mean(slope**2))
    assert np.median(errors) < 1e-2
    assert np.percentile(errors, 95) < 0.1


def test_light_goes_on_where_blocks_change():
    """All the way down each step's change is what the rates at both ends say: levels pass into each other unseen."""
    p, step_ns = parameters(sun_elevation_deg=60.0, reflectance=Lambert(1.0)), 2_000_000
    light, rate = (np.zeros(CAMERA.size[::-1], np.float32) for _ in range(2))
    with RasterTerrain(p, CAMERA) as scene:
        chosen = set()
        for k in range(150):
            t_ns = round(30e9) + k * 200_000_000
            scene.light_and_rate(t_ns, light, rate)
            first, slope = light.copy(), rate.copy()
            scene.light_and_rate(t_ns + step_ns, light, rate)
            beyond = np.abs(light - first - (slope + rate) * (step_ns * 0.5e-9)) / first.mean()
            assert np.percentile(beyond, 99) < 2e-3
            assert (beyond > 0.02).sum() <= 3  # where a facet gives way to another, fine heights are found from it anew
            assert beyond.max() < 0.2
            chosen.add(scene.facets_drawn)
    assert len(chosen) > 5  # blocks did change


def test_threads_draw_the_same_to_the_last_bit():
    p = parameters()
    for one, three in zip(looked_at(p, 10**10), looked_at(p, 10**10, threads=3), strict=True):
        np.testing.assert_array_equal(one, three)


def test_levels_have_the_ground_s_heights_and_keep_means():
    ground = make_ridge(RIDGE)
    sun = np.array([0.6, 0.0, 0.8])
    pyramid = build_pyramid(ground, np.ones_like(ground.heights_m), sun, ground.grids + 3)
    coarser = None
    for level in range(ground.grids + 3):
        offset, rows, columns = pyramid.levels[level, :3]
        posts = pyramid.posts[offset : offset + rows * columns].reshape(rows, columns, 4)
        stride = 1 << max(level - ground.grids + 1, 0)
        np.testing.assert_array_equal(posts[..., 0], ground.heights_m[min(level, ground.grids - 1), ::stride, ::stride])
        inner = posts[rows // 4 : 3 * rows // 4, columns // 4 : 3 * columns // 4, 1:]
        if level >= ground.grids:
            np.testing.assert_allclose(inner.mean(axis=(0, 1)), coarser, atol=0.02)
        coarser = inner.mean(axis=(0, 1))


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
    light, rate = looked_at(parameters(camera=path), 0)
    assert not light.any()
    assert not rate.any()


def test_ground_behind_the_camera_is_cut_off():
    """Two metres above the ground on coarse posts, the horizon in the middle: facets begin behind the camera."""
    path = KeyframePath((Keyframe(0.0, (0.0, 0.0, 152.0)), Keyframe(1.0, (0.0, 0.5, 152.0))), (0.0, 400.0, 100.0))
    ground = dataclasses.replace(RIDGE, ridge_m=0.0, finest_m=8.0)
    light, rate = looked_at(parameters(camera=path, ground=ground), 500_000_000)
    assert np.isfinite(light).all()
    assert np.isfinite(rate).all()
    assert (light[-4:] > 0).all()


def test_a_map_of_any_size_is_drawn_to_its_edge(tmp_path):
    np.save(tmp_path / "odd.npy", np.zeros((43, 71)))
    flat = Heightmap(path=str(tmp_path / "odd.npy"), post_m=4.0)
    p = parameters(ground=flat, camera=FixedPath((0.0, 0.0, 400.0), DOWN), body_radius_m=0.0, ambient_w_m2=10.0)
    light, _ = looked_at(p, 0)
    covered = (light > 0).sum() / (70 * 42 * (4.0 * CAMERA.focal_px / 400.0) ** 2)
    assert 1 <= covered < 1.08  # pixels that the edge passes count whole


def test_the_part_of_the_picture_that_changed_holds_the_ground():
    p = parameters(camera=FixedPath((0.0, 0.0, 50.0), look_at_m=(0.0, 500.0, 50.0)))
    light, rate = (np.zeros(CAMERA.size[::-1], np.float32) for _ in range(2))
    with RasterTerrain(p, CAMERA) as scene:
        scene.light_and_rate(0, light, rate)
        assert scene.changed is None
        scene.light_and_rate(1_000_000, light, rate)
        region = scene.changed
    rows = np.flatnonzero(light.any(axis=1))
    assert region.first_row <= rows.min()
    assert region.last_row > rows.max()
