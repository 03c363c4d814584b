"""The truth by rays against closed forms that share nothing with it, and its convergence."""

import math

import numpy as np
import pytest
import trimesh

from emulator.geometry.camera import Pinhole
from emulator.photometry.reflectance import Lambert, Sun
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.scene.terrain.ground import nested
from emulator.scene.terrain.table import Heightmap, TerrainParameters
from emulator.trajectory.parameters import FixedPath
from laboratory.accuracy.sampled_scenes import SampledBodies, SampledTerrain, _first_hit, _peaks

CAMERA = Pinhole(64, 48, 100.0)
FAR = 10.0  # m, of the plane
BALL_M, RADIUS_M = np.array([-1.5, 0.0, 8.5]), 0.5
TO_SUN = np.array([-1.0, 0.0, -1.0]) / math.sqrt(2)
DOWN = (0.0, 1.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def shapes(tmp_path_factory):
    pytest.importorskip("embreex", reason="the ray caster of the truth")
    folder = tmp_path_factory.mktemp("shapes")
    trimesh.creation.icosphere(3, RADIUS_M).export(folder / "ball.obj")
    trimesh.creation.icosphere(6, 1.0).export(folder / "globe.obj")
    rough = trimesh.creation.icosphere(4, 1.0)
    rough.vertices *= 1 + np.random.default_rng(2).normal(0, 0.015, (len(rough.vertices), 1))
    rough.export(folder / "rough.obj")
    trimesh.creation.box((8.0, 8.0, 1.0)).export(folder / "slab.obj")
    trimesh.creation.box((0.275, 0.175, 0.2)).export(folder / "brick.obj")
    return folder


def light(scene, t_ns=0):
    with scene:
        out = np.zeros(scene.size[::-1], np.float32)
        scene.light(t_ns, out)
    return out.astype(float)


def body(shape, position_m, **more):
    return BodyTable(shape=str(shape), path=FixedPath(position_m), reflectance=Lambert(1.0), **more)


def shadow_of_a_ball(shapes, sun_au):
    """Return the unshadowed share of the light of a plane before the camera, beside a ball outside the frame."""
    bodies = (
        body(shapes / "slab.obj", (0.0, 0.0, FAR + 0.5), smooth=False, throws_shadow=False),
        body(shapes / "ball.obj", tuple(BALL_M)),
    )
    parameters = BodiesParameters(bodies=bodies, sun=Sun(tuple(TO_SUN), sun_au), detail_px=0.0)
    seen = light(SampledBodies(parameters, CAMERA))[:, 22:]  # the ball itself is left of it
    return seen / (parameters.sun.irradiance_w_m2 / math.pi / math.sqrt(2))


def true_share(columns, rows, sun_radius_rad):
    """Return the share of the light at places on the plane: by solid angles, of many points of the disc."""
    x, y = (columns - 32) * FAR / 100, (rows - 24) * FAR / 100
    to_ball = BALL_M - np.stack([x, y, np.full_like(x, FAR)], axis=-1)
    distance = np.linalg.norm(to_ball, axis=-1)
    k = np.arange(4000) + 0.5
    r, turn = sun_radius_rad * np.sqrt(k / k.size), k * 2.399963
    across, up = np.array([0.0, 1.0, 0.0]), np.cross(TO_SUN, [0.0, 1.0, 0.0])
    disc = TO_SUN + np.outer(r * np.cos(turn), across) + np.outer(r * np.sin(turn), up)
    disc /= np.linalg.norm(disc, axis=1, keepdims=True)
    seen = (to_ball / distance[..., None]) @ disc.T < np.sqrt(1 - (RADIUS_M / distance[..., None]) ** 2)
    return (seen * -disc[:, 2]).mean(axis=-1) * math.sqrt(2)


def test_the_edge_of_a_shadow_is_in_its_place(shapes):
    """A Sun of almost no size: an ellipse whose axes are those of the ball, longer by the slope of the light."""
    hidden = 1 - shadow_of_a_ball(shapes, 100.0)
    width, middle = hidden.sum(axis=1), (hidden * (np.arange(22, 64) + 0.5)).sum(axis=1)
    rows = np.arange(48) + 0.5 - 24
    finer = np.arange(-0.5, 0.5, 0.01) + 0.005 + rows[:, None]
    half = (10 * RADIUS_M * math.sqrt(2) * np.sqrt(np.maximum(1 - (finer / (10 * RADIUS_M)) ** 2, 0))).mean(axis=1)
    inside = np.abs(rows) < 4
    assert np.abs(width / 2 - half)[inside].max() < 0.05
    assert np.abs((middle / np.maximum(width, 1e-9))[inside] - 32).max() < 0.05
    assert width.sum() == pytest.approx(100 * math.pi * RADIUS_M**2 * math.sqrt(2), rel=0.003)


def test_a_penumbra_is_as_wide_as_the_sun(shapes):
    sun = Sun(tuple(TO_SUN), 0.05)
    seen = shadow_of_a_ball(shapes, 0.05)
    columns, rows = np.meshgrid(np.arange(22, 64, 0.25) + 0.125, np.arange(14, 34, 0.25) + 0.125)
    truth = true_share(columns, rows, sun.radius_rad).reshape(20, 4, 42, 4).mean(axis=(1, 3))
    assert (truth < 0.01).any()
    assert ((truth > 0.1) & (truth < 0.9)).sum() > 60
    assert np.sqrt(((seen[14:34] - truth) ** 2).mean()) < 0.01
    assert np.abs(seen[14:34] - truth).max() < 0.06


def test_a_flat_body_covers_the_share_of_pixels_that_it_covers(shapes):
    for z, dark in ((2.1, 0.0), (3.0, 1.0)):
        lit = body(shapes / "brick.obj", (0.1, 0.05, z), smooth=False)
        black = BodyTable(shape=str(shapes / "brick.obj"), path=FixedPath((0.1, 0.05, 2.6)), smooth=False)
        parameters = BodiesParameters(bodies=(lit, black), sun=Sun((0.0, 0.0, -1.0)), shadows=False, detail_px=0.0)
        seen = light(SampledBodies(parameters, CAMERA)) / (parameters.sun.irradiance_w_m2 / math.pi)
        wide, high = 100 * 0.275 / (z - 0.1), 100 * 0.175 / (z - 0.1)
        if not dark:
            assert seen.sum() == pytest.approx(wide * high, rel=0.01)
            assert seen.max() == pytest.approx(1.0, abs=1e-4)
        else:
            assert seen.max() < 0.99  # the nearer brick is before it


def eros(**more):
    spin = FixedPath((0.1, 0.05, 5.0), (0.5, 0.5, -0.5, 0.5))
    table = BodyTable(shape="eros007790", units_m=0.06, path=spin, reflectance=Lambert(0.3))
    return BodiesParameters(bodies=(table,), detail_px=0.0, **more)


SMALL = Pinhole.of_field((96, 72), 30.0)


def test_no_place_on_the_night_side_is_lit(shapes):
    """The Sun stands behind a closed body: a lit place would be seen through it, but at the outline."""
    seen = light(SampledBodies(eros(sun=Sun((0.0, 0.0, 1.0))), SMALL))
    around = light(SampledBodies(eros(sun=Sun((0.0, 0.0, -1.0)), shadows=False), SMALL)) > 0
    inner = around.copy()
    for _ in range(2):
        inner[1:-1, 1:-1] &= inner[:-2, 1:-1] & inner[2:, 1:-1] & inner[1:-1, :-2] & inner[1:-1, 2:]
    assert inner.sum() > 500
    assert not seen[inner].any()


def step_ground(tmp_path, sun_au):
    """Return the light of level ground east of a plateau 20 m high under a Sun in the west, 20 degrees high."""
    columns = np.arange(257) - 128
    heights = np.tile(np.clip(-5.0 * (columns + 0.0), 0.0, 20.0), (65, 1))  # down over 4 posts of 2 m, to x = 0
    np.save(tmp_path / "map.npy", heights)
    parameters = TerrainParameters(
        ground=Heightmap(str(tmp_path / "map.npy"), post_m=2.0), camera=FixedPath((48.0, 0.0, 480.0), DOWN),
        sun_azimuth_deg=270.0, sun_elevation_deg=20.0, sun_distance_au=sun_au, ambient_w_m2=0.0,
        reflectance=Lambert(1.0), body_radius_m=0.0,
    )  # fmt: skip
    full = Sun(distance_au=sun_au).irradiance_w_m2 / math.pi * math.sin(math.radians(20.0))
    return light(SampledTerrain(parameters, Pinhole(96, 16, 480.0))) / full


def test_a_shadow_on_the_ground_ends_where_its_plateau_lets_it(tmp_path):
    """A pixel is a metre; the shadow of the plateau's edge, at x = -8 m, ends at 20 m / tan 20 deg from there."""
    seen = step_ground(tmp_path, 100.0)
    end = 20 / math.tan(math.radians(20)) - 8
    assert 96 - seen.sum(axis=1) == pytest.approx(end, abs=0.05)
    assert (seen[:, : int(end) - 1] == 0).all()


def test_rays_over_nested_grids_are_those_of_small_steps():
    rng = np.random.default_rng(5)
    grids = [np.cumsum(rng.normal(0, 0.3, (33, 33)), axis=0) + rng.normal(0, 1.0, (33, 33)) for _ in range(4)]
    ground = nested(0.5, grids)
    packed = ground.heights_m, np.ones_like(ground.heights_m), *_peaks(ground.heights_m), ground.unit_m
    met = 0
    for _ in range(200):
        start = np.append(rng.uniform(-60, 60, 2), rng.uniform(3, 8))
        ray = np.append(rng.normal(0, 1, 2), rng.normal(-0.1, 0.15))
        t = _first_hit(packed, tuple(start), tuple(ray))
        steps = np.arange(0.0, 150.0, 0.01)
        places = start + steps[:, None] * ray
        heights = [ground.height_m(x, y) for x, y in places[::10, :2]]
        below = np.array([h is not None and z <= h for h, z in zip(heights, places[::10, 2], strict=True)])
        if not below.any():
            assert t > 140 or abs(places[0, 2]) < 1 or _is_thin(ground, start, ray, t)
            continue
        first = steps[::10][below.argmax()]
        assert t <= first + 1e-6
        assert t >= first - 0.1 - 1e-6 or _is_thin(ground, start, ray, t)
        met += 1
    assert met > 60


def _is_thin(ground, start, ray, t):
    """Return whether a ray is at the ground's height after t: small steps may miss a crest."""
    x, y, z = start + t * ray
    return abs(z - ground.height_m(x, y)) < 1e-6
