"""One body in sunlight: closed forms of its light, where its points land, and that nothing but time matters."""

import functools
import math

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from emulator.geometry.attitude import spin, unit
from emulator.geometry.camera import Pinhole
from emulator.light import SceneError
from emulator.photometry.reflectance import SUN_W_M2, LommelSeeliger, Sun, henyey_greenstein
from emulator.scene.bodies import models as models_module
from emulator.scene.bodies.gl_bodies import GlBodies
from emulator.scene.bodies.mesh import find_shape, load_mesh
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.trajectory.parameters import FixedPath, SpinPath
from tests.emulator.scene.bodies.test_bodies import renderer as renderer

Bodies = GlBodies


NS = 1_000_000_000
SIZE = (120, 90)
BALL_M = 1000.0
UP = (0.0, -1.0, 0.0)
ALBEDO = 0.33


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """Return what writes a ball into a file and returns its name."""
    folder = tmp_path_factory.mktemp("balls")

    @functools.cache
    def written(radius_m=BALL_M, at=(0.0, 0.0, 0.0), subdivisions=5):
        sphere = trimesh.creation.icosphere(subdivisions, radius_m)
        sphere.apply_translation(at)
        path = folder / f"ball-{radius_m}-{at}-{subdivisions}.obj"
        sphere.export(path)
        return str(path)

    return written


@pytest.fixture(scope="module", autouse=True)
def each_shape_is_read_once():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(models_module, "load_mesh", functools.cache(load_mesh))
        yield


def eros(**more):
    return {"shape": "eros007790", "units_m": 1000.0, **more}


def scene(
    shape, *, size=SIZE, range_m=100_000.0, field_deg=25.0, sun=(-0.8, -0.2, -0.6), samples=2, units_m=1.0,
    q=(1.0, 0.0, 0.0, 0.0), asymmetry=-0.25, albedo=ALBEDO, **path,
):  # fmt: skip
    """Return a scene of a body that spins at the origin, on the boresight of a camera `range_m` away."""
    w, x, y, z = q
    body = BodyTable(
        shape=shape, units_m=units_m, path=SpinPath(**{"pole": UP, **path}),
        reflectance=LommelSeeliger(albedo, asymmetry),
    )  # fmt: skip
    eye = tuple(-range_m * Rotation.from_quat([x, y, z, w]).apply([0, 0, 1]))
    parameters = BodiesParameters(
        camera=FixedPath(eye, q), sun=Sun(sun), samples=samples, detail_px=0.0, shadows=False, bodies=(body,)
    )
    return Bodies(parameters, Pinhole.of_field(size, field_deg))


def picture(body, t_ns=0):
    out = np.full(body.size[::-1], np.nan, np.float32)
    body.light(t_ns, out)
    return out


def shoot(shape, t_ns=0, **more):
    with scene(shape, **more) as body:
        return picture(body, t_ns)


def full_disc(asymmetry=-0.25):
    """Return the radiance of the whole disc, seen from the Sun."""
    return SUN_W_M2 * ALBEDO / (8 * math.pi) * henyey_greenstein(0.0, asymmetry)


def sun_at_phase(phase_deg):
    g = math.radians(phase_deg)
    return (math.sin(g), 0.0, -math.cos(g))


@pytest.mark.parametrize("phase_deg", [1.0, 30.0, 90.0, 130.0])
def test_a_distant_ball_shines_as_lommel_and_seeliger_integrate(ball, phase_deg):
    field_deg = 2 * math.degrees(math.atan(1.5e-6))  # the disc takes two thirds of the width
    light = shoot(ball(), range_m=1e6 * BALL_M, field_deg=field_deg, sun=sun_at_phase(phase_deg), samples=4)
    g = math.radians(phase_deg)
    disc = 1 - math.sin(g / 2) * math.tan(g / 2) * math.log(1 / math.tan(g / 4))
    want = math.pi * 40**2 * disc * henyey_greenstein(g, -0.25) / henyey_greenstein(0.0, -0.25)
    assert light.sum(dtype=np.float64) / full_disc() == pytest.approx(want, rel=4e-3)


@pytest.mark.parametrize("phase_deg", [0.0, 50.0, 110.0])
@pytest.mark.parametrize("asymmetry", [-0.25, 0.0])
def test_each_pixel_of_a_near_ball_follows_the_closed_form(ball, phase_deg, asymmetry):
    range_m, sun = 4 * BALL_M, np.array(sun_at_phase(phase_deg))
    light = shoot(
        ball(subdivisions=6), range_m=range_m, field_deg=40.0, sun=tuple(sun), asymmetry=asymmetry, samples=1
    ) / full_disc(asymmetry)
    focal = SIZE[0] / 2 / math.tan(math.radians(20))
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2, np.arange(SIZE[1]) + 0.5 - SIZE[1] / 2)
    ray = np.stack([x, y, np.full_like(x, focal)], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    middle = ray[..., 2] * range_m
    root2 = middle**2 - range_m**2 + BALL_M**2
    distance = middle - np.sqrt(np.maximum(root2, 0))
    normal = (ray * distance[..., None] - [0, 0, range_m]) / BALL_M
    mu0, mu = normal @ sun, -(normal * ray).sum(axis=-1)
    phase = np.arccos(np.clip(-ray @ sun, -1, 1))
    thrown = henyey_greenstein(phase, asymmetry) / henyey_greenstein(0.0, asymmetry)
    want = 2 * thrown * mu0 / (mu0 + mu)
    off_limb = (root2 > 0) & (mu > 0.15) & (mu0 > 0.05)
    assert off_limb.sum() > 1000
    if Bodies is RasterBodies:  # the mean over a pixel, which curves where the light falls steeply
        off_limb &= (mu > 0.4) & (mu0 > 0.4)
    np.testing.assert_allclose(light[off_limb], want[off_limb], rtol=3e-3, atol=3e-3)
    beyond = 0.2 if Bodies is RasterBodies else 0.02  # a pixel's mean reaches over the edges by its width
    assert not light[(root2 > 0) & (mu0 < -beyond)].any()
    assert not light[root2 < -beyond * BALL_M**2].any()


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


def scalar_first(camera):
    x, y, z, w = Rotation.from_rotvec(camera).as_quat()
    return w, x, y, z


@pytest.mark.parametrize(("pole", "camera", "turned_deg"), ATTITUDES)
def test_a_point_off_the_axis_lands_where_the_pinhole_says(ball, pole, camera, turned_deg):
    point = np.array([700.0, 150.0, 300.0])
    behind_camera = -Rotation.from_rotvec(camera).apply([0, 0, 1])
    light = shoot(
        ball(30.0, tuple(point), subdivisions=3),
        t_ns=2 * NS,
        spin_deg_s=turned_deg / 2,
        pole=pole,
        sun=tuple(behind_camera),
        q=scalar_first(camera),
        range_m=5000.0,
        samples=4,
    )
    assert light.any()
    np.testing.assert_allclose(centroid(light), projected(point, pole, camera, turned_deg, 5000.0, 25.0), atol=0.12)


def test_light_depends_on_nothing_but_time():
    with scene(**eros(spin_deg_s=5.0)) as body:
        first = picture(body, 7 * NS)
        for t in (0, 1, 50 * NS):
            picture(body, t)
        np.testing.assert_array_equal(first, picture(body, 7 * NS))
        thirty_days = 30 * 86_400 * NS  # 36 000 turns
        np.testing.assert_array_equal(first, picture(body, thirty_days + 7 * NS))
        assert not np.array_equal(first, picture(body, 8 * NS))


def test_no_vertex_moves_faster_than_the_bound():
    pole, spin_deg_s, range_m = (0.2, -1.0, 0.4), 3.0, 30e3
    vertices = load_mesh(find_shape("eros007790"), 1000.0).vertices
    focal_px = Pinhole.of_field(SIZE, 60.0).focal_px
    with scene(**eros(spin_deg_s=spin_deg_s, range_m=range_m, field_deg=60.0, pole=pole)) as body:
        places = []
        for turns in (0.2, 0.2 + 1e-6):
            x, y, z = (spin(unit(pole), turns) @ vertices.T) + [[0], [0], [range_m]]
            places.append(focal_px * np.stack([x, y]) / z)
        fastest = np.linalg.norm(places[1] - places[0], axis=0).max() / (1e-6 * 360 / spin_deg_s)
        assert body.motion_bound_px_s / 6 < fastest <= body.motion_bound_px_s


def test_more_samples_than_gl_draws_are_refused():
    if Bodies is RasterBodies:
        pytest.skip("the CPU draws without samples")
    with pytest.raises(SceneError, match="use fewer samples"):
        scene(**eros(field_deg=10.0, samples=4, size=(40_000, 8)))
