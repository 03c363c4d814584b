from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from emulator.scene.attitude import matrix_of, spin, unit
from emulator.scene.base import SceneError
from emulator.scene.body import Body, BodyParameters, henyey_greenstein
from emulator.scene.mesh import build_mesh, find_shape, load_mesh
from emulator.scene.raster import Raster
from emulator.scene.stage import Rectangle

NS = 1_000_000_000
SIZE = (120, 90)
BALL_M = 1000.0


def needs_gl(test):
    return pytest.mark.gl(pytest.mark.usefixtures("gl")(test))


def ball(radius_m=BALL_M, at=(0.0, 0.0, 0.0), subdivisions=5):
    sphere = trimesh.creation.icosphere(subdivisions, radius_m)
    return build_mesh(np.asarray(sphere.vertices) + at, sphere.faces)


def shoot(mesh=None, size=SIZE, t_ns=0, **parameters):
    out = np.full((size[1], size[0]), np.nan, np.float32)
    with Body(BodyParameters(**parameters), size, mesh) as body:
        body.light(t_ns, out)
    return out


def sun_at_phase(phase_deg):
    g = math.radians(phase_deg)
    return (math.sin(g), 0.0, -math.cos(g))


@needs_gl
@pytest.mark.parametrize("phase_deg", [1.0, 30.0, 90.0, 130.0])
def test_a_distant_ball_shines_as_lommel_and_seeliger_integrate(phase_deg):
    range_m = 1e6 * BALL_M
    field_deg = 2 * math.degrees(math.atan(1.5e-6))  # the disc takes two thirds of the width
    light = shoot(ball(), range_m=range_m, field_of_view_deg=field_deg, sun=sun_at_phase(phase_deg), samples=4)
    g = math.radians(phase_deg)
    disc = 1 - math.sin(g / 2) * math.tan(g / 2) * math.log(1 / math.tan(g / 4))
    want = math.pi * 40**2 * disc * henyey_greenstein(g, -0.25)
    assert light.sum(dtype=np.float64) == pytest.approx(want, rel=4e-3)


@needs_gl
@pytest.mark.parametrize("phase_deg", [0.0, 50.0, 110.0])
@pytest.mark.parametrize("asymmetry", [-0.25, 0.0])
def test_each_pixel_of_a_near_ball_follows_the_closed_form(phase_deg, asymmetry):
    range_m, sun = 4 * BALL_M, np.array(sun_at_phase(phase_deg))
    light = shoot(
        ball(subdivisions=6), range_m=range_m, field_of_view_deg=40.0, sun=tuple(sun), asymmetry=asymmetry, samples=1
    )
    focal = SIZE[0] / 2 / math.tan(math.radians(20))
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2, np.arange(SIZE[1]) + 0.5 - SIZE[1] / 2)
    ray = np.stack([x, y, np.full_like(x, focal)], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    middle = ray[..., 2] * range_m
    root2 = middle**2 - range_m**2 + BALL_M**2
    distance = middle - np.sqrt(np.maximum(root2, 0))
    normal = (ray * distance[..., None] - [0, 0, range_m]) / BALL_M
    mu0, mu = normal @ sun, -(normal * ray).sum(axis=-1)
    want = 2 * henyey_greenstein(math.radians(phase_deg), asymmetry) * mu0 / (mu0 + mu)
    off_limb = (root2 > 0) & (mu > 0.15) & (mu0 > 0.05)
    assert off_limb.sum() > 1000
    np.testing.assert_allclose(light[off_limb], want[off_limb], rtol=3e-3, atol=3e-3)
    assert not light[(root2 > 0) & (mu0 < -0.02)].any()
    assert not light[root2 < -0.02 * BALL_M**2].any()


def test_the_phase_function_is_henyey_and_greensteins():
    assert henyey_greenstein(0.0, -0.25) == 1.0
    assert henyey_greenstein(math.pi, -0.25) == pytest.approx((0.75 / 1.25) ** 3)
    assert henyey_greenstein(1.0, 0.0) == 1.0
    assert henyey_greenstein(1.0, -0.3) < 1 < henyey_greenstein(1.0, 0.3)


ATTITUDES = [
    # pole, camera rotation vector, turned by (deg)
    ((0, -1, 0), (0, 0, 0), 0),
    ((0, -1, 0), (0, 0, 0), 65),
    ((0, 0, 1), (0.4, -0.3, 0.9), 120),
    ((0, 0, -2), (0.0, 2.0, 0.1), 200),
    ((0.3, -0.5, 0.8), (-1.0, 0.4, 0.3), 310),
]


def projected(point, pole, camera, turned_deg, range_m, field_deg):
    """Where OpenCV's pinhole puts a point of the body; world_from_body built in scipy from the words of `spin`."""
    pole = np.array(pole) / np.linalg.norm(pole)
    node = np.cross([0, 0, 1], pole)
    node = node / np.linalg.norm(node) if node.any() else np.array([1.0, 0, 0])
    untwisted, _ = Rotation.align_vectors([pole, node], [[0, 0, 1], [1, 0, 0]])
    world = Rotation.from_rotvec(math.radians(turned_deg) * pole).apply(untwisted.apply(point))
    eye = Rotation.from_rotvec(camera)
    seen = eye.inv().apply(world + eye.apply([0, 0, range_m]))
    focal = SIZE[0] / 2 / math.tan(math.radians(field_deg) / 2)
    return focal * seen[:2] / seen[2] + np.array(SIZE) / 2


def centroid(light):
    rows, columns = np.indices(light.shape) + 0.5
    return np.array([(light * columns).sum(), (light * rows).sum()]) / light.sum()


@needs_gl
@pytest.mark.parametrize(("pole", "camera", "turned_deg"), ATTITUDES)
def test_a_point_off_the_axis_lands_where_the_pinhole_says(pole, camera, turned_deg):
    point = np.array([700.0, 150.0, 300.0])
    x, y, z, w = Rotation.from_rotvec(camera).as_quat()
    behind_camera = -Rotation.from_rotvec(camera).apply([0, 0, 1])
    light = shoot(
        ball(30.0, point, subdivisions=3),
        t_ns=2 * NS,
        spin_deg_s=turned_deg / 2,
        pole=pole,
        sun=tuple(behind_camera),
        q_world_from_camera=(w, x, y, z),
        range_m=5000.0,
        field_of_view_deg=25.0,
        samples=4,
    )
    assert light.any()
    np.testing.assert_allclose(centroid(light), projected(point, pole, camera, turned_deg, 5000.0, 25.0), atol=0.12)


@needs_gl
def test_in_plain_words_it_turns_to_the_east():
    bump = ball(30.0, (500.0, 0.0, 0.0), subdivisions=3)
    aim = {"range_m": 2000.0, "field_of_view_deg": 40.0, "sun": (0.0, 0.0, -1.0), "samples": 4, "spin_deg_s": 10.0}
    # pole up: +X is on the right at first, goes away from us behind the pole, and comes back in front from the left
    right, behind, left, before = (shoot(bump, t_ns=i * 9 * NS, **aim) for i in range(4))
    assert centroid(right)[0] > 80
    assert centroid(left)[0] < 40
    assert before.sum() > 2 * behind.sum() > 0
    # pole turned down: on the right first as well? No: the node is z cross pole, to the left
    assert centroid(shoot(bump, pole=(0.0, 1.0, 0.0), **aim))[0] < 40


@needs_gl
def test_eros_shows_its_crater_psyche_and_not_its_mirror():
    # Psyche lies near 32 north, 272 east; with +X to the right and the pole up we look at 270 east
    light = shoot(size=(300, 200), sun=(-0.8, -0.2, -0.6), range_m=100_000.0, field_of_view_deg=25.0)
    rim_left, rim_right = light[75:85, 134:140].mean(), light[75:85, 158:164].mean()
    assert rim_right > 1.15 * rim_left  # a bowl lit from the left is bright on its right wall


@needs_gl
@pytest.mark.parametrize("samples", [2, 3, 4])
def test_supersampling_is_the_plain_mean_of_light(samples):
    aim = {"shape": "eros007790", "start_deg": 40.0, "sun": (1.0, 0.5, -0.2)}
    fine = shoot(size=(80 * samples, 60 * samples), samples=1, **aim)
    want = fine.reshape(60, samples, 80, samples).mean(axis=(1, 3))
    np.testing.assert_allclose(shoot(size=(80, 60), samples=samples, **aim), want, atol=1e-5)


@needs_gl
def test_light_depends_on_nothing_but_time():
    p = BodyParameters(shape="eros007790", spin_deg_s=5.0)
    a, b = np.zeros((2, 90, 120), np.float32)
    with Body(p, SIZE) as body:
        body.light(7 * NS, a)
        for t in (0, 1, 50 * NS):
            body.light(t, b)
        body.light(7 * NS, b)
        np.testing.assert_array_equal(a, b)
        body.light(30 * 86_400 * NS + 7 * NS, b)  # 36 000 turns later
        np.testing.assert_array_equal(a, b)
        body.light(8 * NS, b)
        assert not np.array_equal(a, b)


@needs_gl
@pytest.mark.parametrize(("pole", "camera", "turned_deg"), ATTITUDES)
def test_drawing_only_where_the_body_can_be_cuts_nothing(pole, camera, turned_deg):
    x, y, z, w = Rotation.from_rotvec(camera).as_quat()
    p = BodyParameters(
        shape="eros007790", pole=pole, q_world_from_camera=(w, x, y, z), start_deg=turned_deg, range_m=26e3,
        field_of_view_deg=110.0, samples=1,
    )  # fmt: skip
    part, whole = np.zeros((2, 90, 120), np.float32)
    with Body(p, SIZE) as body:
        body.light(0, part)
        view, mesh = body._view(turned_deg / 360), body.mesh
    raster = Raster(mesh, SIZE, 1, Rectangle(0, 0, *SIZE))
    raster.draw([view], [whole])
    raster.close()
    assert whole.any()
    np.testing.assert_allclose(part, whole, atol=1e-3)  # GL interpolates from another corner


@needs_gl
def test_no_vertex_moves_faster_than_the_bound():
    p = BodyParameters(shape="eros007790", spin_deg_s=3.0, range_m=30e3, field_of_view_deg=60.0, pole=(0.2, -1, 0.4))
    with Body(p, SIZE) as body:
        places = []
        for turns in (0.2, 0.2 + 1e-6):
            x, y, z = (spin(unit(p.pole), turns) @ body.mesh.vertices.T) + [[0], [0], [p.range_m]]
            places.append(body.focal_px * np.stack([x, y]) / z)
        fastest = np.linalg.norm(places[1] - places[0], axis=0).max() / (1e-6 * 360 / p.spin_deg_s)
        assert body.motion_bound_px_s / 6 < fastest <= body.motion_bound_px_s


@needs_gl
def test_black_pictures_are_black():
    assert not shoot(ball(), range_m=4000.0, sun=(0.0, 0.0, 1.0)).any()
    assert not shoot(ball(), range_m=4000.0, light_at_zero_phase=0.0).any()


@needs_gl
def test_holes_show_the_sky():
    whole = load_mesh(find_shape("eros007790"))
    torn = build_mesh(whole.vertices, np.delete(whole.faces, slice(None, None, 3), axis=0))
    assert torn.open_edges > 0
    light = shoot(torn, sun=(0.0, 0.0, -1.0))
    assert np.isfinite(light).all()
    assert 0 < (light > 0).sum() < (shoot(whole, sun=(0.0, 0.0, -1.0)) > 0).sum()


@needs_gl
def test_it_writes_into_any_array():
    out = np.full((90, 240), -1.0, np.float32)
    with Body(BodyParameters(shape="eros007790"), SIZE) as body:
        assert body.size == SIZE
        body.light(0, out[:, ::2])
        want = np.empty((90, 120), np.float32)
        body.light(0, want)
    np.testing.assert_array_equal(out[:, ::2], want)
    assert (out[:, 1::2] == -1).all()


@needs_gl
def test_two_scenes_in_one_thread_do_not_disturb_each_other():
    first, second = (BodyParameters(shape="eros007790", start_deg=a) for a in (0.0, 90.0))
    a, b, again = np.empty((3, 90, 120), np.float32)
    with Body(first, SIZE) as one:
        one.light(0, a)
        with Body(second, SIZE) as two:
            two.light(0, b)
            one.light(0, again)
        np.testing.assert_array_equal(a, again)
        one.light(0, again)
    np.testing.assert_array_equal(a, again)
    assert not np.array_equal(a, b)


@needs_gl
def test_a_closed_scene_says_so():
    body = Body(BodyParameters(shape="eros007790"), SIZE)
    body.close()
    body.close()
    with pytest.raises(SceneError, match="closed"):
        body.light(0, np.empty((90, 120), np.float32))


@needs_gl
def test_more_samples_than_gl_draws_are_refused():
    with pytest.raises(SceneError, match="use fewer samples"):
        Body(BodyParameters(shape="eros007790", field_of_view_deg=10.0, samples=4), (40_000, 8))


def test_a_camera_inside_the_body_is_refused():
    with pytest.raises(SceneError, match=r"inside it\. Move it out, or look at units_m"):
        Body(BodyParameters(range_m=10_000.0), SIZE)


def test_a_body_too_small_to_be_sampled_is_refused():
    with pytest.raises(SceneError, match=r"0\.096 px across .* look at units_m"):
        Body(BodyParameters(units_m=1.0), SIZE)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"range_m": 0.0}, "range_m is 0: it must be above 0"),
        ({"range_m": math.nan}, "range_m is nan"),
        ({"units_m": -1.0}, "units_m is -1"),
        ({"pole": (0, 0, 0)}, "pole is all zeros"),
        ({"sun": (0, math.nan, 1)}, "sun is"),
        ({"q_world_from_camera": (0, 0, 0, 0)}, "q_world_from_camera is all zeros"),
        ({"field_of_view_deg": 180.0}, "between 0 and 180"),
        ({"samples": 5}, "must be 1, 2, 3 or 4"),
        ({"light_at_zero_phase": -1.0}, "light_at_zero_phase is -1"),
        ({"asymmetry": 1.0}, "between -1 and 1"),
        ({"spin_deg_s": math.inf}, "spin_deg_s is inf"),
    ],
)
def test_wrong_parameters_say_what_would_be_right(wrong, says):
    with pytest.raises(ValueError, match=says):
        BodyParameters(**wrong)


def test_quaternions_are_scalar_first():
    turn = Rotation.from_rotvec([0.3, -1.2, 0.5])
    x, y, z, w = turn.as_quat()
    np.testing.assert_allclose(matrix_of([3 * w, 3 * x, 3 * y, 3 * z]), turn.as_matrix(), atol=1e-15)


@pytest.mark.parametrize("pole", [(0, 0, 1), (0, 0, -1), (1e-9, 0, 1), (1, 0, 0), (0.3, -0.5, 0.8)])
def test_spin_is_a_rotation_about_the_pole(pole):
    pole = unit(pole)
    matrix = spin(pole, 0.37)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1)
    np.testing.assert_allclose(matrix @ [0, 0, 1], pole, atol=1e-12)
    tenth = Rotation.from_rotvec(0.2 * np.pi * pole).as_matrix()
    np.testing.assert_allclose(spin(pole, 0.47) @ matrix.T, tenth, atol=1e-12)
