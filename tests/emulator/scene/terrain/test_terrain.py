"""Ground drawn: blocks that tile it, closed-form light, no cracks, no jumps, and what is refused."""

import dataclasses
import math

import numpy as np
import pytest
import scipy.ndimage

from emulator.geometry.camera import Pinhole
from emulator.light import SceneError
from emulator.photometry.reflectance import SUN_W_M2, Hapke, Lambert, LommelSeeliger, LunarLambert, Sun
from emulator.scene.terrain.gl_terrain import GlTerrain
from emulator.scene.terrain.raster_terrain import RasterTerrain
from emulator.scene.terrain.relief import make_albedo
from emulator.scene.terrain.table import Heightmap, Ridge, TerrainParameters
from emulator.trajectory.laws import Gate
from emulator.trajectory.parameters import DescentPath, FixedPath, Keyframe, KeyframePath

CAMERA = Pinhole.of_field((96, 64), 60.0)
DOWN = (0.0, 1.0, 0.0, 0.0)  # x right east, y down south, the boresight to the nadir
RIDGE = Ridge(size_m=1024.0, finest_m=2.0, posts=128, ridge_m=100.0, seed=2)


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


def parameters(**changes):
    plain = TerrainParameters(
        ground=RIDGE, camera=FixedPath((0.0, 0.0, 150.0), DOWN), sun_elevation_deg=20.0, ambient_w_m2=0.0, samples=1
    )
    return dataclasses.replace(plain, **changes)


@pytest.fixture(params=[pytest.param(GlTerrain, marks=pytest.mark.gl), RasterTerrain])
def terrain(request):
    """Each renderer."""
    return request.param


def drawn(terrain, p, times_ns=(0,), camera=CAMERA):
    pictures = []
    with terrain(p, camera) as scene:
        for t_ns in times_ns:
            out = np.full(camera.size[::-1], np.nan, np.float32)
            scene.light(t_ns, out)
            assert np.isfinite(out).all()
            pictures.append(out)
    return pictures if len(pictures) > 1 else pictures[0]


def flat_map(folder, posts=65, post_m=8.0):
    np.save(folder / "flat.npy", np.zeros((posts, posts)))
    return Heightmap(path=str(folder / "flat.npy"), post_m=post_m)


# Blocks


# Light


@pytest.mark.parametrize("law", [Lambert(0.5), LommelSeeliger(), LunarLambert(0.12), Hapke()])
def test_level_ground_has_the_light_of_its_law(terrain, tmp_path, law):
    p = parameters(ground=flat_map(tmp_path), reflectance=law, body_radius_m=0.0, sun_azimuth_deg=30.0)
    light = drawn(terrain, p)
    rows, columns = np.mgrid[:64, :96] + 0.5
    ray = np.stack([(columns - 48) / CAMERA.focal_px, -(rows - 32) / CAMERA.focal_px, -np.ones_like(rows)], -1)
    eye = -ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    a, e = math.radians(30.0), math.radians(20.0)
    sun = np.array([math.sin(a) * math.cos(e), math.cos(a) * math.cos(e), math.sin(e)])
    expected = SUN_W_M2 * law.reflect(np.full(rows.shape, sun[2]), eye[..., 2], np.arccos(eye @ sun))
    np.testing.assert_allclose(light, expected, rtol=2e-3)


def test_a_slope_is_lit_by_its_own_normal_and_stands_where_it_is(terrain, tmp_path):
    """East of the middle the ground rises by one in four; seen from above the crease is in the middle column."""
    x = (np.arange(65) - 32) * 8.0
    np.save(tmp_path / "slope.npy", np.tile(np.maximum(0, x / 4), (65, 1)))
    ground = Heightmap(path=str(tmp_path / "slope.npy"), post_m=8.0)
    p = parameters(
        ground=ground, reflectance=Lambert(1.0), body_radius_m=0.0, sun_azimuth_deg=-90.0, sun_elevation_deg=40.0
    )
    light = drawn(terrain, p)
    e = math.radians(40.0)
    level = SUN_W_M2 / math.pi * math.sin(e)
    slope = SUN_W_M2 / math.pi * (math.sin(e) * 4 + math.cos(e)) / math.sqrt(17)
    crease_px = math.ceil(
        8.0 * CAMERA.focal_px / (150.0 - 2.0)
    )  # a post wide: there light passes from one to the other
    np.testing.assert_allclose(light[:, : 48 - crease_px], level, rtol=2e-3)
    np.testing.assert_allclose(light[:, 48 + crease_px :], slope, rtol=2e-3)


def test_a_wall_s_shadow_reaches_as_far_as_the_sun_is_low(terrain, tmp_path):
    heights = np.zeros((129, 129))
    heights[:, 80:84] = 20.0
    np.save(tmp_path / "wall.npy", heights)
    p = parameters(
        ground=Heightmap(path=str(tmp_path / "wall.npy"), post_m=2.0),
        reflectance=Lambert(1.0),
        body_radius_m=0.0,
        sun_azimuth_deg=90.0,
        sun_elevation_deg=15.0,
    )
    row = drawn(terrain, p)[32]
    focal, reach_m = CAMERA.focal_px, 20.0 / math.tan(math.radians(15.0))
    begins = 48 + (32.0 - reach_m) * focal / 150.0  # the wall's foot is 32 m east of the middle
    assert np.flatnonzero(row[:58] > 0.5 * row[5]).max() + 1 == pytest.approx(begins, abs=1.5)


@pytest.mark.gl
@pytest.mark.parametrize("beyond_m", [0.5, 1.0, 2.0, 3.2])
def test_a_shadow_ends_between_posts_with_the_whole_penumbra(tmp_path, beyond_m):
    """The posts are 4 m apart and the penumbra is 1.9 m wide, so that none or one of the posts lies in it."""
    heights = np.zeros((129, 129))
    heights[:, 89:] = 100.0  # from 100 m east of the middle on
    np.save(tmp_path / "step.npy", heights)
    elevation = math.atan2(100.0, 100.0 - beyond_m)
    p = parameters(
        ground=Heightmap(path=str(tmp_path / "step.npy"), post_m=4.0),
        camera=FixedPath((2.0, 0.0, 20.0), DOWN),
        reflectance=Lambert(1.0),
        body_radius_m=0.0,
        sun_azimuth_deg=90.0,
        sun_elevation_deg=math.degrees(elevation),
        samples=8,
    )
    light = drawn(GlTerrain, p)
    x = 2.0 + ((np.arange(96 * 8) + 0.5) / 8 - 48) * 20.0 / CAMERA.focal_px
    radii = np.clip((elevation - np.arctan2(100.0, 100.0 - x)) / Sun().radius_rad, -1, 1)
    share = 1 - (np.arccos(radii) - radii * np.sqrt(1 - radii**2)) / math.pi
    expected = SUN_W_M2 / math.pi * math.sin(elevation) * share.reshape(96, 8).mean(axis=1)
    assert expected[10] == pytest.approx(expected.max())
    assert expected[-10] == 0
    np.testing.assert_allclose(light, np.tile(expected, (64, 1)), atol=0.05 * expected.max())


@pytest.mark.parametrize("radii", [-0.5, 0.0, 0.3])
def test_a_rising_sun_lights_level_ground_from_the_part_of_its_disc_above_the_horizon(terrain, tmp_path, radii):
    radius = Sun().radius_rad
    p = parameters(
        ground=flat_map(tmp_path),
        reflectance=Lambert(1.0),
        body_radius_m=0.0,
        sun_elevation_deg=math.degrees(radii * radius),
    )
    heights = (np.arange(20000) + 0.5) / 10000 - 1  # of lines across the disc, in radii
    mean = np.average(np.maximum(radii + heights, 0), weights=np.sqrt(1 - heights**2)) * radius
    np.testing.assert_allclose(drawn(terrain, p)[16:48, 24:72], SUN_W_M2 / math.pi * mean, rtol=0.01)


@pytest.mark.gl
def test_light_seen_at_a_slant_is_that_of_the_map_and_not_of_coarse_facets(tmp_path):
    """Waves with flat sides, a quarter steep, seen 22 degrees and more from above, so that none hides another."""
    posts = np.arange(257)
    profile = np.abs((posts - 3) % 16 - 8) * 2.0  # of posts 8 m apart
    np.save(tmp_path / "waves.npy", np.tile(profile[::-1, None], (1, 257)))  # the north is on top
    p = parameters(
        ground=Heightmap(path=str(tmp_path / "waves.npy"), post_m=8.0),
        camera=FixedPath((0.0, -700.0, 450.0), look_at_m=(0.0, 0.0, -50.0)),
        reflectance=Lambert(1.0),
        body_radius_m=0.0,
        sun_azimuth_deg=0.0,
        sun_elevation_deg=60.0,
        samples=8,
        detail_px=4.0,
    )
    light = drawn(GlTerrain, p)[:, 48]
    y, z = (posts - 128) * 8.0, profile - profile[128]
    down = math.atan2(500.0, 700.0) + np.arctan(((np.arange(64 * 8) + 0.5) / 8 - 32) / CAMERA.focal_px)
    along = np.linspace(300.0, 2000.0, 34001)
    expected = np.zeros(64 * 8)
    for k, angle in enumerate(down):
        places = -700.0 + along * math.cos(angle)
        first = np.argmax(450.0 - along * math.sin(angle) < np.interp(places, y, z))
        slope = np.interp(places[first], y, np.gradient(z, 8.0))
        expected[k] = (math.sin(math.radians(60)) - slope * math.cos(math.radians(60))) / math.hypot(1, slope)
    expected = SUN_W_M2 / math.pi * expected.reshape(64, 8).mean(axis=1)
    error = light[12:] / expected[12:] - 1
    assert np.sqrt(np.mean(error**2)) < 0.003


def test_albedo_dims_and_brightens_the_light_of_the_sun(terrain):
    level = Ridge(1024.0, 8.0, 128, ridge_m=0.0, slope_deg=0.0, crater_density=0.0, boulder_cover=0.0)
    lit, plain = (
        drawn(terrain, parameters(ground=dataclasses.replace(level, albedo_rms=rms), samples=2)) for rms in (0.1, 0.0)
    )
    rows, columns = np.mgrid[:64, :96] + 0.5
    posts = [64 + place * 150.0 / CAMERA.focal_px / 8.0 for place in (32 - rows, columns - 48)]
    albedo = make_albedo(dataclasses.replace(level, albedo_rms=0.1))
    expected = scipy.ndimage.map_coordinates(albedo[0], posts, order=1)
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(lit / plain, expected, rtol=0.01)


DOWNWARD = DescentPath((Gate(0.0, 400.0, 0.0, 10.0, 50.0), Gate(60.0, 30.0, 0.0, 3.0, 80.0), Gate(70.0, 8.0)))
ACROSS = KeyframePath((Keyframe(0.0, (-180.0, 5.0, 25.0)), Keyframe(70.0, (180.0, 5.0, 25.0))), (0.0, 20.0, -150.0))


@pytest.mark.system
@pytest.mark.parametrize("path", [DOWNWARD, ACROSS], ids=["down", "across the borders of grids"])
def test_there_are_no_cracks_and_nothing_jumps_on_the_way(terrain, path):
    """Lambert ground under a high Sun, so that nothing on it is dark."""
    p = parameters(camera=path, sun_elevation_deg=85.0, reflectance=Lambert(1.0), ambient_w_m2=50.0)
    times = [round(t * 1e9) for t in np.linspace(0, 69, 60)]
    close = [t + 200_000 for t in times]  # 2 mm later
    pictures = drawn(terrain, p, [t for pair in zip(times, close, strict=True) for t in pair])
    for before, after in zip(pictures[::2], pictures[1::2], strict=True):
        ground = before[28:]  # the map ends above
        assert ground.min() > 5  # a crack would show the black sky; ambient light alone gives 15
        assert np.median(np.abs(after - before)) < 1e-3 * np.median(before)
        assert (np.abs(after - before) > 0.2 * before.max()).sum() <= 2  # samples on a rim's outline may change sides


def test_a_night_is_told(terrain):
    p = parameters(sun_elevation_deg=-10.0)
    with terrain(p, CAMERA) as scene:
        assert "below the horizontal" in scene.notes[-2]
        assert "black" in scene.notes[-1]


def test_motion_is_bounded_by_path_and_height(terrain, tmp_path):
    path = KeyframePath((Keyframe(0.0, (0, 0, 100), DOWN), Keyframe(10.0, (50.0, 0, 100), DOWN)))
    p = parameters(ground=flat_map(tmp_path), camera=path, body_radius_m=0.0)
    with terrain(p, CAMERA) as scene:
        nadir = CAMERA.focal_px * 5.0 / 100
        assert nadir < scene.motion_bound_px_s < 3 * nadir
        assert scene.distance_m == pytest.approx(100.0)
        light, rate = (np.zeros(CAMERA.size[::-1], np.float32) for _ in range(2))
        scene.light_and_rate(1_000_000_000, light, rate)
        assert not scene.has_rate or np.isfinite(rate).all()


# What is refused


def test_a_camera_below_the_ground_is_told_when_and_where():
    path = KeyframePath((Keyframe(0.0, (0, 0, 20.0), DOWN), Keyframe(10.0, (0, 0, -20.0), DOWN)))
    with pytest.raises(SceneError, match=r"m below the ground at 5\.\d+ s, x = .* m, y = "):
        RasterTerrain(parameters(camera=path), CAMERA)


def test_a_path_that_cannot_be_used_is_a_scene_error():
    with pytest.raises(SceneError, match=r"scene\.camera: an empty trajectory"):
        RasterTerrain(parameters(camera=KeyframePath()), CAMERA)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"samples": 9}, "samples must be .*, got 9"),
        ({"sun_elevation_deg": 91.0}, "sun_elevation_deg must be .*, got 91"),
        ({"ambient_w_m2": math.nan}, "ambient_w_m2 must be .*, got nan"),
        ({"time_scale": 0.0}, "time_scale must be .*, got 0"),
        ({"body_radius_m": 5.0}, "body_radius_m must be .*, got 5"),
    ],
)
def test_nonsense_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        TerrainParameters(**changes)
