"""Light of bodies and its rate: closed forms, finite differences, frames, and bodies in each other's shadow."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from emulator.geometry.camera import Pinhole
from emulator.photometry.reflectance import Glossy, Hapke, Lambert, LommelSeeliger, LunarLambert, Sun
from emulator.scene.bodies.lighting import Lighting, motion_at
from emulator.scene.bodies.lit_surface import lit_surface, subdivide
from emulator.scene.bodies.mesh import Mesh, build_mesh
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.parameters import FixedPath, Keyframe, KeyframePath, SpinPath
from emulator.trajectory.pose import Timescale


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def unit(v):
    return np.asarray(v, float) / np.linalg.norm(v)


def mesh_of(made, by=(0, 0, 0)):
    made.apply_translation(by)
    return build_mesh(made.vertices, made.faces)


def ball(level=4, radius=1.0):
    return mesh_of(trimesh.creation.icosphere(level, radius))


def body(law=None, path=None, **more):
    return BodyTable(shape="any", reflectance=law or Lambert(1.0), path=path or FixedPath(), **more)


class World:
    """Bodies with meshes, and what lights them."""

    def __init__(self, bodies, meshes, sizes=None, clock=1.0, **more):
        if isinstance(more.get("camera"), FixedPath):
            more["camera"] = replace(more["camera"], look_at_m=(0.0, 0.1, 0.0), up=(1.0, 0.0, 0.0))
        self.p = BodiesParameters(bodies=tuple(bodies), time_scale=clock, **more)
        fine = [m if s is None else subdivide(m, s) for m, s in zip(meshes, sizes or [None] * len(meshes), strict=True)]
        self.surfaces = [lit_surface(m, smooth=b.smooth) for b, m in zip(bodies, fine, strict=True)]
        self.lighting = Lighting(self.p, Pinhole(400, 400, 0.1), meshes, self.surfaces)  # sees nearly all before it
        self.paths = [build_trajectory(b.path) for b in bodies]
        self.camera, self.clock = build_trajectory(self.p.camera), Timescale(clock)

    def poses(self, t):
        found = []
        for table, path in zip(self.p.bodies, self.paths, strict=True):
            parent = [b.name for b in self.p.bodies].index(table.fixed_to) if table.fixed_to else None
            found.append(path.pose(t) if parent is None else found[parent].after(path.pose(t)))
        return found

    def light(self, t_ns=0):
        return self.lighting.light_and_polygons(motion_at(t_ns, self.camera, self.poses, self.clock))[0]


def test_a_lambert_ball_has_the_cosine_of_incidence():
    sun = Sun((1.0, 0.0, 0.0), 2.0)
    world = World([body()], [ball()], sun=sun, camera=FixedPath((5.0, 5.0, 0.0)))
    surface_light = world.light()[0]
    surface = world.surfaces[0]
    mu0 = surface.normals[:, 0]
    seen = surface.normals @ unit([1, 1, 0]) > 0.3
    clear = np.abs(mu0) > math.sin(sun.radius_rad) + 0.01
    expected = sun.irradiance_w_m2 / math.pi * np.maximum(mu0, 0)
    np.testing.assert_allclose(surface_light.radiance[seen & clear], expected[seen & clear], rtol=1e-9, atol=1e-12)
    assert (surface_light.radiance[surface.normals @ unit([1, 1, 0]) < -0.1] == 0).all()
    assert (surface_light.rate == 0).all()


def test_the_terminator_of_a_ball_is_as_wide_as_the_sun():
    """Irradiance as the integral of the cosine over the part of the disc above the tangent plane, sampled."""
    sun = Sun((1.0, 0.0, 0.0), 0.05)  # a disc of 5.3 degrees' radius
    k = np.arange(200_000) + 0.5
    height = np.sqrt(k / len(k)) * np.sin(k * math.pi * (3 - math.sqrt(5)))
    world = World([body()], [ball(5)], sun=sun, camera=FixedPath((0.0, 0.0, 9.0)))
    surface_light, normals = world.light()[0], world.surfaces[0].normals
    near = np.flatnonzero((np.abs(normals[:, 0]) < 1.1 * sun.radius_rad) & (normals[:, 2] > 0.4))[::7]
    assert len(near) > 30
    for n in near:
        elevation = math.asin(normals[n, 0])
        mean = np.maximum(elevation + sun.radius_rad * height, 0).mean()
        assert surface_light.radiance[n] == pytest.approx(
            sun.irradiance_w_m2 / math.pi * mean, abs=1.5e-3 * sun.irradiance_w_m2 / math.pi
        )
    assert surface_light.radiance[near].max() > 0
    assert surface_light.radiance[(normals[:, 0] < -math.sin(sun.radius_rad) - 0.02)].max() == 0


LAWS = [Lambert(), LommelSeeliger(), LunarLambert(), Hapke(), Glossy()]


def spinning(law, smooth=True, ambient=0.0):
    """A ball with a crest around it, and a box, that tumble before a moving camera."""
    ridge = trimesh.util.concatenate([trimesh.creation.icosphere(4, 1.0), trimesh.creation.annulus(0.8, 1.5, 0.2)])
    path = SpinPath(pole=(0.3, 1.0, 0.2), spin_deg_s=20.0)
    camera = KeyframePath(
        (Keyframe(0.0, (3.0, 2.0, -6.0)), Keyframe(9.0, (-3.0, 1.0, -5.0))), look_at_m=(0.0, 0.0, 0.0)
    )
    mesh = build_mesh(ridge.vertices, ridge.faces)
    sizes = [None if smooth else 0.1]
    sun = Sun((-0.5, 0.3, -0.8), 0.2)
    return World([body(law, path, smooth=smooth)], [mesh], sizes, sun=sun, camera=camera, ambient_w_m2=ambient)


@pytest.mark.parametrize("smooth", [True, False])
@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.kind)
def test_rates_are_those_of_finite_differences_also_in_penumbras(law, smooth):
    world, t, h = spinning(law, smooth, ambient=3.0), 2_000_000_000, 20_000
    before, now, after = (world.light(t + k * h)[0] for k in (-1, 0, 1))
    difference = (after.radiance - before.radiance) / (2e-9 * h)
    shown = (before.radiance > 0) & (after.radiance > 0)
    wrong = np.abs(now.rate - difference)[shown]
    scale = np.abs(difference[shown]) + 1e-3 * np.abs(difference).max()
    assert np.median(wrong / scale) < 1e-5
    assert np.quantile(wrong / scale, 0.995) < 0.02  # kinks: an edge touches the disc, a horizon passes an azimuth
    assert np.isfinite(now.rate).all()


@pytest.mark.system
def test_the_rate_is_right_while_a_wall_s_shadow_passes():
    """A post on a table that turns: points pass through the penumbra one after the other."""
    table = trimesh.util.concatenate(
        [
            trimesh.creation.box(bounds=[(-3, -3, -0.2), (3, 3, 0)]),
            trimesh.creation.box(bounds=[(0.5, -0.3, 0), (1, 0.3, 1.5)]),
        ]
    )
    path = SpinPath(pole=(0.0, 0.0, 1.0), spin_deg_s=5.0)
    world = World(
        [body(path=path, smooth=False)],
        [build_mesh(table.vertices, table.faces)],
        [0.05],
        sun=Sun((0.8, 0.1, 0.5)),
        camera=FixedPath((0.0, 0.0, 20.0)),
    )
    step = 10**6
    lights = [world.light(10**9 + k * step)[0] for k in range(80)]
    radiance, rate = (np.array([getattr(g, name) for g in lights]) for name in ("radiance", "rate"))
    grown = radiance[-1] - radiance[0]
    integral = (0.5 * (rate[1:] + rate[:-1])).sum(axis=0) * step * 1e-9
    passed = np.abs(grown) > 0.1 * radiance.max()
    assert passed.sum() > 20
    np.testing.assert_allclose(integral[passed], grown[passed], atol=0.02 * radiance.max())


def test_a_moon_goes_through_a_shadow():
    """A small ball passes behind a large one: dark in the middle, and its light's rate adds up to its light."""
    path = KeyframePath((Keyframe(0.0, (20.0, -6.0, 0.0)), Keyframe(12.0, (20.0, 6.0, 0.0))))
    world = World(
        [body(), body(path=path)],
        [ball(4, 2.0), ball(2, 0.2)],
        sun=Sun((-1.0, 0.0, 0.0)),
        camera=FixedPath((0.0, 0.0, 60.0)),
    )
    radiance, rate = [], []
    times = np.arange(3_000_000_000, 9_000_000_000, 10_000_000)
    for t in times:
        surface_light = world.light(int(t))[1]
        radiance.append(surface_light.radiance.sum())
        rate.append(surface_light.rate.sum())
    radiance, rate = np.array(radiance), np.array(rate)
    middle = len(times) // 2
    assert radiance[middle] == 0
    assert radiance[0] == pytest.approx(radiance[-1], rel=0.05)
    assert radiance[0] > 10
    integral = np.concatenate([[0], np.cumsum(0.5 * (rate[1:] + rate[:-1])) * 0.01])
    np.testing.assert_allclose(integral, radiance - radiance[0], atol=0.02 * radiance[0])
    dark_s = (radiance < 0.5 * radiance[0]).sum() * 0.01
    assert dark_s == pytest.approx(2 * 2.0 / 1.0, rel=0.03)  # the shadow is as wide as the ball


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("smooth", [True, False])
def test_a_part_shades_another_of_its_group_also_under_an_overhang(smooth):
    """A ball hangs over a table: light falls in below it, which a table of horizons would lose."""
    plate, hung = mesh_of(trimesh.creation.box((8.0, 8.0, 0.2)), (0, 0, -0.1)), ball(3, 0.8)
    fine = subdivide(plate, 0.1)
    plate = build_mesh(fine.vertices, fine.faces)  # with normals of its own, those of the box lean at its corners
    bodies = [
        body(path=SpinPath(spin_deg_s=1.0), name="plate", smooth=smooth),
        body(path=FixedPath((0.0, 0.0, 2.0)), fixed_to="plate"),
    ]
    for sun, place in (((0.9, 0.0, 0.44), (-4.1, 0.0)), ((0.1, 0.1, 1.0), (-0.2, -0.2))):
        world = World(bodies, [plate, hung], sun=Sun(sun), camera=FixedPath((0.0, 0.0, 30.0)))
        surface_light, surface = world.light()[0], world.surfaces[0]
        towards, turn = unit(sun), world.poses(0)[0].world_from_body
        points = surface.points @ turn.T
        beside = np.linalg.norm(np.cross(np.array([0, 0, 2.0]) - points, towards), axis=1)
        top = (surface.normals[:, 2] > 0.9) & (np.abs(points[:, :2]) < 3.9).all(axis=1)
        lit, dark = surface_light.radiance[top & (beside > 0.83)], surface_light.radiance[top & (beside < 0.76)]
        assert (lit > 0.99 * lit.max()).all()
        assert len(dark) > 20 or abs(place[0]) > 4
        assert (dark == 0).all()


def test_a_body_that_throws_no_shadow_throws_none():
    moon = body(path=FixedPath((-5.0, 0.0, 0.0)), throws_shadow=False)
    args = {"sun": Sun((-1.0, 0.0, 0.0)), "camera": FixedPath((-9.0, 9.0, 0.0))}
    alone = World([body()], [ball(3)], **args).light()[0]
    np.testing.assert_array_equal(World([body(), moon], [ball(3), ball(3)], **args).light()[0].radiance, alone.radiance)
    thrown = World([body(), body(path=moon.path)], [ball(3), ball(3)], **args).light()[0]
    assert thrown.radiance.sum() < 0.3 * alone.radiance.sum()
    off = World([body(), body(path=moon.path)], [ball(3), ball(3)], shadows=False, **args).light()[0]
    np.testing.assert_allclose(off.radiance, alone.radiance, rtol=1e-9)


def test_ambient_light_fills_the_night():
    world = World([body()], [ball(3)], sun=Sun((0.0, 0.0, 1.0)), camera=FixedPath((0.0, 0.0, -9.0)), ambient_w_m2=2.0)
    surface_light, normals = world.light()[0], world.surfaces[0].normals
    towards = np.array([0, 0, -9.0]) - world.surfaces[0].points
    mu = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    night = normals[:, 2] < -0.3
    np.testing.assert_allclose(surface_light.radiance[night], 2.0 / math.pi * mu[night], rtol=1e-9)


def test_degenerate_points_give_no_nan():
    good = ball(2)
    bad = good.normals.copy()
    bad[0], bad[1] = 0.0, np.nan
    mesh = Mesh(good.vertices, good.faces, bad)
    for eye in ((0.0, 0.0, -5.0), tuple(lit_surface(good, smooth=True).points[7]), (0.0, 0.0, 0.0)):
        world = World([body(Glossy())], [mesh], sun=Sun((0.2, 0.1, -1.0)), camera=FixedPath(eye), ambient_w_m2=1.0)
        surface_light = world.light()[0]
        assert np.isfinite(surface_light.radiance).all()
        assert np.isfinite(surface_light.rate).all()
        assert (surface_light.radiance >= 0).all()
