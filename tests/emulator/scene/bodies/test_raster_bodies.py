"""Bodies drawn by the CPU: against point samples, their exact rate, single pixels, regions, and hostile shapes."""

import dataclasses

import numpy as np
import pytest
import trimesh

from emulator.geometry.camera import Pinhole
from emulator.optics.lens import LensParameters
from emulator.optics.through import Through
from emulator.photometry.reflectance import Glossy, Lambert, LommelSeeliger, Sun
from emulator.rig.kinds import CAMERA_MODELS
from emulator.rig.loading import load_rig
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.trajectory.parameters import FixedPath, SpinPath
from laboratory.accuracy.sampled_scenes import SampledBodies

SIZE = (96, 72)
CAMERA = Pinhole.of_field(SIZE, 30.0)
MS = 1_000_000


@pytest.fixture(scope="module")
def shapes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shapes")
    trimesh.creation.icosphere(4, 1.0).export(folder / "ball.obj")
    trimesh.creation.box((2.0, 1.0, 1.5)).export(folder / "box.obj")
    return folder


def eros(**more):
    """Return Eros at 1 : 17 000, 1 m long to each side."""
    return spinning("eros007790", units_m=0.06, **more)


def spinning(shape, deg_s=20.0, **more):
    path = SpinPath((0.1, 0.05, 5.0), (0.2, 1.0, 0.1), spin_deg_s=deg_s)
    return BodyTable(shape=str(shape), path=path, reflectance=more.pop("law", LommelSeeliger()), **more)


def scene(*bodies, sun=(0.6, -0.3, -0.7), **more):
    return BodiesParameters(bodies=bodies, sun=Sun(sun), detail_px=0.0, **more)


def frame(body, t_ns):
    light, rate = (np.zeros(body.size[::-1], np.float32) for _ in range(2))
    body.light_and_rate(t_ns, light, rate)
    return light.astype(float), rate.astype(float)


@pytest.mark.sampled
@pytest.mark.parametrize("shadows", [False, True])
@pytest.mark.parametrize("body", ["ball", "eros"])
def test_light_is_that_of_many_point_samples(shapes, body, shadows):
    pytest.importorskip("embreex", reason="the ray caster of the reference")
    parameters = scene(eros() if body == "eros" else spinning(shapes / "ball.obj"), shadows=shadows)
    with RasterBodies(parameters, CAMERA) as body, SampledBodies(parameters, CAMERA, 16) as reference:
        light, _ = frame(body, 300 * MS)
        truth = np.zeros(SIZE[::-1], np.float32)
        reference.light(300 * MS, truth)
    seen = truth > 0
    error = np.abs(light - truth)[seen] / truth[seen].mean()
    assert np.median(error) < 0.001
    assert np.quantile(error, 0.99) < 0.07  # at outlines: the truth's facets are curved


def test_a_flat_box_with_a_highlight_is_that_of_many_point_samples(shapes):
    pytest.importorskip("embreex", reason="the ray caster of the reference")
    body = spinning(shapes / "box.obj", smooth=False, law=Glossy(0.3, 0.2, 40.0))
    parameters = scene(body, ambient_w_m2=5.0)
    with RasterBodies(parameters, CAMERA) as drawn, SampledBodies(parameters, CAMERA, 16) as reference:
        light, _ = frame(drawn, 700 * MS)
        truth = np.zeros(SIZE[::-1], np.float32)
        reference.light(700 * MS, truth)
    error = np.abs(light - truth)[truth > 0] / truth[truth > 0].mean()
    assert np.median(error) < 0.002
    assert np.quantile(error, 0.99) < 0.04


@pytest.mark.system
def test_the_rate_is_the_slope_of_finely_sampled_light(shapes):
    """Differences of 256 x 256 samples, over a motion of an eighth of a pixel: the reference knows nothing of rates."""
    pytest.importorskip("embreex", reason="the ray caster of the reference")
    parameters = scene(spinning(shapes / "box.obj", smooth=False), shadows=False)
    small = Pinhole.of_field((24, 18), 30.0)
    with RasterBodies(parameters, small) as body, SampledBodies(parameters, small, 256) as reference:
        _, rate = frame(body, 300 * MS)
        before, after = np.zeros((2, 18, 24), np.float32)
        reference.light(280 * MS, before)
        reference.light(320 * MS, after)
    slope = (after.astype(float) - before) / 0.04
    moving = np.abs(slope) > 0.05 * np.abs(slope).max()
    error = np.abs(rate - slope)[moving] / np.abs(slope[moving])
    assert moving.sum() > 30
    assert np.median(error) < 0.02
    assert np.quantile(error, 0.95) < 0.15


def test_frames_in_the_same_arrays_are_those_in_fresh_ones(shapes):
    """Only the part that changed is written; the rest must be what a whole frame has."""
    parameters = scene(spinning(shapes / "box.obj", deg_s=300.0))
    chip = CAMERA_MODELS["davis346"].chip
    lens = LensParameters(field_of_view_deg=60.0, blur_px=0.8)
    with Through(lens, chip, SIZE, lambda camera: RasterBodies(parameters, camera)) as seen:
        light, rate = (np.zeros(SIZE[::-1], np.float32) for _ in range(2))
        for k in range(6):
            seen.light_and_rate(k * 100 * MS, light, rate)
            fresh, _ = frame(seen, k * 100 * MS)
            seen.light_and_rate(k * 100 * MS, light, rate)
            seen.light_and_rate((k * 100 + 1) * MS, light, rate)
            assert seen.changed is not None
            assert not seen.changed.empty
            rows = seen.changed.last_row - seen.changed.first_row
            assert rows < SIZE[1]
            again, again_rate = frame(seen, (k * 100 + 1) * MS)
            np.testing.assert_array_equal(light, again)
            np.testing.assert_array_equal(rate, again_rate)
            assert not np.array_equal(fresh, again)


@pytest.mark.system
@pytest.mark.parametrize("rig", ["eros", "itokawa", "rendezvous", "eros-flyover"])
def test_shipped_rigs_have_finite_light_and_rate(rig):
    rig = load_rig(rig)
    with RasterBodies(rig.scene, rig.camera.lens.pinhole((173, 130))) as body:
        for t_ns in (0, 40 * MS, 5_000 * MS):
            light, rate = frame(body, t_ns)
            assert np.isfinite(light).all()
            assert np.isfinite(rate).all()
            assert light.min() >= 0
            assert rate.any()


@pytest.mark.parametrize("z_m", [0.0, 0.5, 1.0, -0.3])
def test_a_camera_in_a_body_or_on_its_surface_sees_finite_light(tmp_path, z_m):
    """The camera is outside at the start, as it must be, and goes through the body."""
    trimesh.creation.icosphere(2, 1.0).export(tmp_path / "ball.obj")
    body = BodyTable(shape=str(tmp_path / "ball.obj"), path=FixedPath((0, 0, 3.0)), reflectance=Lambert(1.0))
    with RasterBodies(scene(body, ambient_w_m2=3.0), CAMERA) as drawn:
        drawn._world.arrangement._bodies[0].path._pose = dataclasses.replace(
            drawn._world.arrangement.poses_of([0])(0)[0], position_m=np.array([0.0, 0.0, z_m])
        )
        light, rate = frame(drawn, 0)
    assert np.isfinite(light).all()
    assert np.isfinite(rate).all()


def test_needles_slivers_and_crossing_bodies_are_finite(tmp_path):
    rng = np.random.default_rng(5)
    soup = rng.normal(size=(600, 3)) * [1.0, 1.0, 0.2]
    soup[::3] = soup[1::3] + 1e-9 * rng.normal(size=(200, 3))  # needles
    trimesh.Trimesh(soup, np.arange(600).reshape(-1, 3), process=False).export(tmp_path / "soup.obj")
    trimesh.creation.icosphere(3, 0.8).export(tmp_path / "ball.obj")
    bodies = [BodyTable(shape=str(tmp_path / name), path=FixedPath((0, 0, 4.0))) for name in ("soup.obj", "ball.obj")]
    with RasterBodies(scene(*bodies, shadows=False), CAMERA) as drawn:
        light, rate = frame(drawn, 0)
    assert np.isfinite(light).all()
    assert np.isfinite(rate).all()
    assert light.max() > 0
