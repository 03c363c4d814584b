"""Bodies in sunlight: closed-form spheres, shadows against a ray caster, parents, detail, and what is refused."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh

from emulator.geometry.camera import Pinhole
from emulator.gl.context import QUICK_LOOK
from emulator.light import SceneError
from emulator.photometry.reflectance import SUN_W_M2, Lambert, LommelSeeliger, Sun
from emulator.scene.bodies.gl_bodies import GlBodies
from emulator.scene.bodies.mesh import build_mesh
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.regolith import coarser, facet_size_m
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.trajectory.parameters import FixedPath, Keyframe, KeyframePath, SpinPath

Bodies = GlBodies


@pytest.fixture(autouse=True, params=[RasterBodies, GlBodies], ids=["cpu", "gl"])
def renderer(request):
    """Run each test with both renderers; the second where there is a GL library."""
    if request.param is GlBodies:
        request.getfixturevalue("gl")
    request.module.Bodies = request.param


CAMERA = Pinhole.of_field((64, 48), 30.0)
BEHIND_CAMERA = Sun((0.0, 0.0, -1.0))


@pytest.fixture(scope="module")
def shapes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shapes")
    trimesh.creation.icosphere(4, 1.0).export(folder / "ball.obj")
    trimesh.creation.box((8.0, 8.0, 0.2)).export(folder / "plate.obj")
    trimesh.creation.icosphere(2, 0.6).export(folder / "pebble.obj")
    return folder


def ball(shapes, position=(0.0, 0.0, 10.0), law=None, **more):
    return BodyTable(shape=str(shapes / "ball.obj"), path=FixedPath(position), reflectance=law or Lambert(1.0), **more)


def drawn(bodies, t_ns=0, pinhole=CAMERA, **more):
    parameters = BodiesParameters(bodies=tuple(bodies), **{"sun": BEHIND_CAMERA, "shadows": False, **more})
    out = np.full(CAMERA.size[::-1], np.nan, np.float32)
    with Bodies(parameters, pinhole) as scene:
        scene.light(t_ns, out)
    assert np.isfinite(out).all()
    return out


@pytest.mark.parametrize("phase", [0.0, 1.0, 2.0])
def test_a_lambert_sphere_has_its_phase_curve_s_light(shapes, phase):
    """Irradiance at the camera, summed over pixels: E (R / d)^2 (2 / 3) phi, phi that of a Lambert sphere."""
    far, narrow = ball(shapes, (0.0, 0.0, 200.0)), Pinhole.of_field((64, 48), 0.8)
    light = drawn([far], pinhole=narrow, sun=Sun((math.sin(phase), 0.0, -math.cos(phase))), samples=4)
    curve = 2 / 3 * (math.sin(phase) + (math.pi - phase) * math.cos(phase)) / math.pi
    expected = SUN_W_M2 * (1 / 200) ** 2 * curve
    assert light.sum(dtype=float) / narrow.focal_px**2 == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("range_m", [8.0, 1e9])
def test_a_nearer_body_hides_a_farther_one_whichever_is_named_first(shapes, range_m):
    dark, bright = ball(shapes, (0, 0, range_m), Lambert(0.0)), ball(shapes, (0.7, 0, range_m + 4))
    near = Pinhole.of_field((64, 48), math.degrees(4.2 / range_m))
    one, other = (drawn(both, pinhole=near) for both in ([dark, bright], [bright, dark]))
    np.testing.assert_array_equal(one, other)
    assert one[24, 32] == 0
    assert one.any()


def test_a_panel_goes_with_the_body_it_is_fixed_to(shapes):
    hub = ball(shapes, name="hub")
    turning = dataclasses.replace(hub, path=SpinPath((0, 0, 10.0), (0, -1, 0), spin_deg_s=90.0))
    panel = BodyTable(
        shape=str(shapes / "pebble.obj"), path=FixedPath((3.0, 0.0, 0.0)), fixed_to="hub", reflectance=Lambert(1.0)
    )
    columns = [np.flatnonzero(drawn([turning, panel], t_ns=int(t * 1e9))[24] > 0) for t in (0.0, 1.0)]
    assert np.ptp(columns[0]) > 1.5 * np.ptp(columns[1])  # beside it, then before or behind it


def test_a_moving_camera_sees_a_still_body_move(shapes):
    path = KeyframePath((Keyframe(0.0, (0, 0, 0)), Keyframe(1.0, (2.0, 0, 0))))
    parameters = BodiesParameters(bodies=(ball(shapes),), sun=BEHIND_CAMERA, camera=path, shadows=False)
    light, rate = (np.zeros(CAMERA.size[::-1], np.float32) for _ in range(2))
    with Bodies(parameters, CAMERA) as scene:
        middles = []
        for t_ns in (0, 500_000_000):
            scene.light(t_ns, light)
            middles.append((light.sum(0) * np.arange(64)).sum() / light.sum())
        moved = (middles[0] - middles[1]) / 0.5
        assert moved == pytest.approx(CAMERA.focal_px * 2.0 / 10, rel=0.1)
        assert moved <= scene.motion_bound_px_s
        scene.light_and_rate(500_000_000, light, rate)
        assert np.isfinite(rate).all() == scene.has_rate
        assert not scene.has_rate or np.abs(rate).max() > 0
        assert scene.distance_m == pytest.approx(9.0, rel=0.1)


def test_what_crosses_a_corner_of_a_wide_picture_keeps_the_motion_bound(shapes):
    wide, aside = Pinhole.of_field((640, 480), 120.0), math.radians(50)
    across = np.array([math.cos(aside), 0, -math.sin(aside)])
    start = np.array([10 * math.sin(aside), 0, 10 * math.cos(aside)])
    path = KeyframePath((Keyframe(0.0, tuple(start - 0.1 * across)), Keyframe(0.2, tuple(start + 0.1 * across))))
    pebble = BodyTable(shape=str(shapes / "pebble.obj"), units_m=0.2, path=path, reflectance=Lambert(1.0))
    parameters = BodiesParameters(bodies=(pebble,), sun=Sun(tuple(-start)), shadows=False, samples=4)
    columns, light = [], np.zeros((480, 640), np.float32)
    with Bodies(parameters, wide) as scene:
        for t_ns in (0, 200_000_000):
            scene.light(t_ns, light)
            columns.append((light.sum(0) * np.arange(640)).sum() / light.sum())
        speed = (columns[1] - columns[0]) / 0.2
        assert speed == pytest.approx(wide.focal_px / 10 / math.cos(aside) ** 2, rel=0.05)
        assert speed <= scene.motion_bound_px_s


def test_shadows_fall_where_a_ray_caster_says(shapes):
    """A pebble above a plate in slanting light; rays by trimesh, over embree."""
    pytest.importorskip("embreex", reason="the ray caster of the test group")
    sun = np.array([0.6, -0.3, -0.74])
    plate = BodyTable(shape=str(shapes / "plate.obj"), path=FixedPath((0, 0, 10.0)), reflectance=Lambert(1.0))
    pebble = BodyTable(shape=str(shapes / "pebble.obj"), path=FixedPath((0.3, 0.2, 8.0)), reflectance=Lambert(1.0))
    with_shadow = drawn([plate, pebble], sun=Sun(tuple(sun)), shadows=True, samples=1)
    without = drawn([plate, pebble], sun=Sun(tuple(sun)), shadows=False, samples=1)
    meshes = [trimesh.load_mesh(shapes / name) for name in ("plate.obj", "pebble.obj")]
    for mesh, place in zip(meshes, ((0, 0, 10.0), (0.3, 0.2, 8.0)), strict=True):
        mesh.apply_translation(place)
    world = trimesh.util.concatenate(meshes)
    rows, columns = np.mgrid[:48, :64] + 0.5
    rays = np.stack([(columns - 32) / CAMERA.focal_px, (rows - 24) / CAMERA.focal_px, np.ones_like(rows)], -1)
    rays = rays.reshape(-1, 3)
    hits, ray, facet = world.ray.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
    facing = world.face_normals[facet] @ sun > 0.05
    start = hits + 1e-3 * world.face_normals[facet]
    dark = world.ray.intersects_any(start, np.tile(sun, (len(hits), 1)))
    drawn_dark = (with_shadow.ravel()[ray] < 0.5 * without.ravel()[ray])[facing]
    assert dark[facing].sum() > 40
    assert (drawn_dark != dark[facing]).mean() < 0.02


def test_detail_that_nobody_sees_is_left_out_and_told(shapes):
    far = ball(shapes, (0.0, 0.0, 55.0), LommelSeeliger())
    parameters = BodiesParameters(bodies=(far,), sun=Sun((0.5, 0, -1)), shadows=False, samples=4)
    with Bodies(parameters, CAMERA) as scene:
        (note,) = [one for one in scene.notes if one != QUICK_LOOK]
        assert "facets: the others are too small to be seen" in note
        coarse = np.zeros(CAMERA.size[::-1], np.float32)
        scene.light(0, coarse)
    mesh = build_mesh(*(lambda s: (s.vertices, s.faces))(trimesh.creation.icosphere(4)))
    assert len(coarser(mesh, 0.25).faces) < len(mesh.faces) / 3
    assert coarser(mesh, 1e-3) is mesh
    assert facet_size_m(mesh) == pytest.approx(math.sqrt(4 * math.pi / 5120), rel=0.01)
    gathered = coarser(mesh, 0.25)
    assert np.linalg.norm(gathered.normals, axis=1) == pytest.approx(1.0)
    outward = gathered.vertices / np.linalg.norm(gathered.vertices, axis=1, keepdims=True)
    assert (gathered.normals * outward).sum(axis=1).min() > 0.9999  # the mean of a cell's normals, not one of them


def test_a_black_picture_is_told(shapes):
    with Bodies(BodiesParameters(bodies=(ball(shapes),), sun=Sun((0, 0, 1.0)), shadows=False), CAMERA) as scene:
        assert "black" in scene.notes[-1]


@pytest.mark.parametrize(
    ("position", "units_m", "message"),
    [
        ((0, 0, 0.5), 1.0, r"it would be inside\. Move it out, or look at units_m"),
        ((0, 0, 10.0), 1000.0, r"it would be inside\. Move it out, or look at units_m"),
        ((0, 0, 1e6), 1.0, r"is 0\.00024 px across .* lost between samples: .* look at units_m"),
    ],
)
def test_a_camera_in_the_wrong_place_is_refused(shapes, position, units_m, message):
    with pytest.raises(SceneError, match=message):
        drawn([dataclasses.replace(ball(shapes, position), units_m=units_m)])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: BodiesParameters(), "bodies is empty"),
        (lambda: BodyTable(shape="a", units_m=-1.0), "units_m must be .*, got -1"),
        (lambda: SpinPath(pole=(0.0, 0.0, 0.0)), "pole is all zeros"),
        (lambda: SpinPath(spin_deg_s=math.inf), "spin_deg_s is inf"),
        (lambda: FixedPath(q_world_from_body=(0.0, 0.0, 0.0, 0.0)), "a unit quaternion"),
        (lambda: FixedPath((0.0, 0.0, math.nan)), "position_m is .*nan"),
        (lambda: Sun((0.0, math.nan, 1.0)), "direction is .*nan"),
        (lambda: LommelSeeliger(asymmetry=1.0), "asymmetry must be -0.99 to 0.99"),
        (lambda: BodyTable(), "shape is missing"),
        (lambda: BodiesParameters(bodies=(BodyTable(shape="a", fixed_to="b"),)), "must be the name of an earlier"),
        (lambda: BodiesParameters(bodies=(BodyTable(shape="a"),), samples=9), "samples must be .*, got 9"),
        (lambda: BodiesParameters(bodies=(BodyTable(shape="a"),), ambient_w_m2=math.nan), "ambient_w_m2 .*got nan"),
    ],
)
def test_nonsense_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_path_that_cannot_be_used_is_a_scene_error(shapes):
    with pytest.raises(SceneError, match="scene: an empty trajectory"):
        drawn([ball(shapes)], camera=KeyframePath())


def test_a_flat_box_s_faces_are_each_of_one_light(shapes):
    turned = SpinPath((0, 0, 12.0), (1, 1, 0), start_deg=30.0)
    box = BodyTable(shape=str(shapes / "plate.obj"), path=turned, reflectance=Lambert(0.5), smooth=False)
    slanting = Sun((0.5, -0.2, -0.8))
    sharp, soft = (drawn([dataclasses.replace(box, smooth=s)], sun=slanting, samples=1) for s in (False, True))
    counts = [
        np.sort(np.unique(np.round(light[light > 0] / light.max(), 3), return_counts=True)[1])
        for light in (sharp, soft)
    ]
    in_three = [count[-3:].sum() / count.sum() for count in counts]
    assert in_three[0] > 0.4  # the plate is seen nearly edge-on: the other pixels are on its outline
    assert in_three[0] > 3 * in_three[1]
