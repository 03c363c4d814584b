"""A planet's water and air: the flux of a ball of waves, its rate, clouds over it, the limb, and the truth by rays."""

import dataclasses
import math

import numpy as np
import pytest

from emulator.geometry.camera import Pinhole
from emulator.photometry.reflectance import SUN_W_M2, Lambert, Sun
from emulator.scene.bodies.albedo import clouded
from emulator.scene.bodies.lighting import Lighting, motion_at
from emulator.scene.bodies.lit_surface import lit_surface, near_in_memory, split_sides
from emulator.scene.bodies.mesh import find_shape, load_mesh
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.regolith import coarser, detailed
from emulator.scene.bodies.table import BodiesParameters, BodyTable, Clouds
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.parameters import FixedPath, Keyframe, KeyframePath, SpinPath
from emulator.trajectory.pose import Timescale
from laboratory.accuracy.sampled_scenes import SampledBodies

RADIUS_M, PHASE_RAD, WIND_M_S = 6.4e6, math.radians(40.0), 3.0
SLOPE2 = 0.003 + 0.00512 * WIND_M_S
INDEX = 1.34
OPEN_SEA = {"seed": 12, "path": FixedPath(q_world_from_body=(0.5, 0.5, -0.5, 0.5))}  # in the middle of the glint


def fresnel(angle_rad):
    """Return the share of unpolarised light that water mirrors, by the angles on both sides (Fresnel's sines)."""
    inside = math.asin(math.sin(angle_rad) / INDEX)
    less, more = angle_rad - inside, angle_rad + inside
    return ((math.sin(less) / math.sin(more)) ** 2 + (math.tan(less) / math.tan(more)) ** 2) / 2


def planet(albedo=0.0, path=None, **detail):
    return BodyTable(
        shape="globe",
        units_m=RADIUS_M,
        reflectance=Lambert(albedo),
        path=path or FixedPath(),
        detail=Clouds(wind_m_s=WIND_M_S, **detail),
        throws_shadow=False,
    )


def scene(body, distance_m, **more):
    sun = Sun((math.sin(PHASE_RAD), 0.0, math.cos(PHASE_RAD)))
    camera = FixedPath((0.0, 0.0, distance_m), look_at_m=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
    return BodiesParameters(**{"bodies": (body,), "sun": sun, "camera": camera} | more)


def sea(facet_m=1.0e5):
    """Return a ball that is water all over."""
    mesh = clouded(load_mesh(find_shape("globe"), RADIUS_M), Clouds(), facet_m)
    return dataclasses.replace(mesh, water=np.ones(mesh.faces.shape))


def light_of(drawn):
    with drawn:
        out = np.zeros(drawn.size[::-1], np.float32)
        drawn.light(0, out)
    return out


@pytest.fixture
def airless_ball_of_water(monkeypatch):
    monkeypatch.setattr("emulator.scene.bodies.world.detailed", lambda *_: sea())
    monkeypatch.setattr("emulator.photometry.reflectance._AIR_DEPTH", 0.0)


@pytest.mark.usefixtures("airless_ball_of_water")
def test_a_ball_of_waves_gives_the_flux_of_a_mirror_ball_and_its_brightness_in_the_middle_of_the_glint():
    """A mirror ball gives E R^2 F / 4 d^2 in any direction; tilted mirrors give it times the mean of 1 / cos b."""
    distance_m, pinhole = 300 * RADIUS_M, Pinhole(240, 240, 30_000.0)
    light = light_of(RasterBodies(scene(planet(), distance_m), pinhole)).astype(float)
    tangent = np.linspace(0, 2, 20_001)
    tilted = np.trapezoid(np.hypot(1, tangent) * np.exp(-(tangent**2) / SLOPE2) * 2 * tangent / SLOPE2, tangent)
    share = fresnel(PHASE_RAD / 2)
    expected = SUN_W_M2 * RADIUS_M**2 * share / (4 * distance_m**2) * tilted
    assert light.sum() / pinhole.focal_px**2 == pytest.approx(expected, rel=0.005)
    column = 120 + pinhole.focal_px * RADIUS_M * math.sin(PHASE_RAD / 2) / distance_m
    peak = SUN_W_M2 * share / (4 * math.pi * SLOPE2 * math.cos(PHASE_RAD / 2))
    assert light[119:121, int(column) - 1 : int(column) + 2].mean() == pytest.approx(peak, rel=0.015)


def test_the_rate_of_the_glint_is_the_limit_of_finer_differences():
    clock = Timescale(1.0)
    path = SpinPath(pole=(0.3, 1.0, 0.2), spin_deg_s=1.0)
    camera = KeyframePath(
        keyframes=(
            Keyframe(t_s=0.0, position_m=(-5 * RADIUS_M, 0.0, 5 * RADIUS_M)),
            Keyframe(t_s=10.0, position_m=(5 * RADIUS_M, 0.0, 6 * RADIUS_M)),
        ),
        look_at_m=(0.0, 0.0, 0.0),
    )
    parameters, mesh = scene(planet(path=path), 1.0, camera=camera), sea(2e5)
    surface = lit_surface(mesh, smooth=True)
    lighting = Lighting(parameters, Pinhole(400, 400, 0.1), [mesh], [surface])
    body, eye = build_trajectory(path), build_trajectory(camera)

    def light(t_ns):
        (found,), _ = lighting.light_and_polygons(motion_at(t_ns, eye, lambda t: [body.pose(t)], clock))
        return found.radiance, found.rate

    at, steps = 5_000_000_000, (8_000_000, 4_000_000)
    coarse, fine = ((light(at + h)[0] - light(at - h)[0]) / (2e-9 * h) for h in steps)
    radiance, rate = light(at)
    turn = body.pose(at).world_from_body
    toward = (eye.pose(at).position_m - body.pose(at).position_m) @ turn - surface.points
    mu = (toward * surface.normals).sum(axis=1) / np.linalg.norm(toward, axis=1)
    mu0 = surface.normals @ (np.array(parameters.sun.direction) @ turn)
    bright = (radiance > 1e-3 * radiance.max()) & (mu > 0.01) & (mu0 > 0.01)  # not what appears meanwhile
    assert bright.sum() > 100
    np.testing.assert_allclose(rate[bright], (4 * fine - coarse)[bright] / 3, rtol=2e-5, atol=2e-6 * np.abs(rate).max())


def test_water_lies_where_the_ocean_is_not_under_cloud():
    mesh = clouded(load_mesh(find_shape("globe"), RADIUS_M), Clouds(seed=2), 3e5)
    albedo = mesh.albedo / mesh.albedo.min() * 0.05
    cover = (albedo - 0.05) / 0.65  # at least so much cloud or land: cloud has 0.7, all else less
    assert mesh.water.min() == 0
    assert mesh.water.max() == 1
    assert (mesh.water <= 1 - cover + 1e-9).all()
    dark = albedo < 0.055
    assert (mesh.water[dark] > 0.9).all()
    assert 0.2 < mesh.water.mean() < 0.6
    open_sky = clouded(load_mesh(find_shape("globe"), RADIUS_M), Clouds(seed=2, cloud_cover=0.0), 3e5)
    assert open_sky.water.mean() == pytest.approx(0.71, abs=0.1)  # all but land and ice


def test_air_brightens_the_planet_towards_its_limb(monkeypatch):
    """Even ground: Lambert's law, and what a flat layer scatters once."""
    made = sea()
    ground = dataclasses.replace(made, albedo=np.ones(made.faces.shape), water=np.zeros(made.faces.shape))
    monkeypatch.setattr("emulator.scene.bodies.world.detailed", lambda *_: ground)
    light = light_of(RasterBodies(scene(planet(0.3), 300 * RADIUS_M), Pinhole(240, 240, 30_000.0)))
    y, x = (np.mgrid[:240, :240] + 0.5 - 120) / 100  # radii from the middle
    mu = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    mu0 = x * math.sin(PHASE_RAD) + mu * math.cos(PHASE_RAD)
    seen = (mu > 0.25) & (mu0 > 0.25)
    mu, mu0, light = mu[seen], mu0[seen], light[seen]
    bright = SUN_W_M2 * 0.3 * mu0 / math.pi
    once = 3 / (16 * math.pi) * (1 + math.cos(PHASE_RAD) ** 2) * mu0 / (mu0 + mu)
    air = SUN_W_M2 * once * (1 - np.exp(-0.126 * (1 / mu0 + 1 / mu))) * 0.7**2
    np.testing.assert_allclose(light, bright + air, rtol=0.01)
    assert 0.05 < (air / bright).min() < 0.07
    assert (air / bright).max() > 0.3


def test_the_glint_brightens_open_water_alone(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("emulator.photometry.reflectance._AIR_DEPTH", 0.0)
    body = planet(0.3, seed=18, path=OPEN_SEA["path"])  # half of the water in the glint is under cloud
    pinhole, parameters = Pinhole(160, 160, 400.0), scene(body, 7 * RADIUS_M)
    made, lights = detailed(load_mesh(find_shape("globe"), RADIUS_M), body.detail, RADIUS_M / 60), []
    for water in (made.water, np.ones(made.faces.shape), np.zeros(made.faces.shape)):
        mesh = dataclasses.replace(made, water=water)
        monkeypatch.setattr("emulator.scene.bodies.world.detailed", lambda *_, mesh=mesh: mesh)
        lights.append(light_of(RasterBodies(parameters, pinhole)))
    gain, most, without = lights[0] - lights[2], lights[1] - lights[2], lights[2]
    y, x = (np.mgrid[:160, :160] + 0.5 - 80) / 400.0
    square = 1 + x * x + y * y  # a ray (x, y, -1) from 7 radii above the middle
    near = (7 - np.sqrt(np.maximum(49 - 48 * square, 0))) / square
    incidence = near * x * math.sin(PHASE_RAD) + (7 - near) * math.cos(PHASE_RAD)
    bright = most > 0.3 * most.max()
    albedo = without * math.pi / (0.3 * SUN_W_M2 * incidence) * 0.05 / made.albedo.min()
    free = 1 - (albedo - 0.05) / 0.65  # of cloud over the ocean: its albedo is that share 0.05, the rest 0.7
    assert (free[bright] < 0.3).sum() > 20
    assert (free[bright] > 0.9).sum() > 20
    shown = gain[bright] / most[bright]
    assert np.abs(shown - free[bright]).mean() < 0.02
    assert (shown < free[bright] + 0.1).all()


def test_the_truth_by_rays_has_the_same_glint(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    parameters = scene(planet(0.3, facet_px=2.0, **OPEN_SEA), 7 * RADIUS_M)
    pinhole = Pinhole(96, 96, 240.0)
    drawn, true = light_of(RasterBodies(parameters, pinhole)), light_of(SampledBodies(parameters, pinhole, 8))
    assert np.abs(drawn - true).mean() < 0.015 * true.mean()
    row, column = 48, round(48 + 240 / 7 * math.sin(PHASE_RAD / 2))
    assert true[row, column] > 30.0  # twice and more what the ocean has without glint
    assert drawn[row, column] == pytest.approx(
        true[row, column], rel=0.045
    )  # 2 % by straight lines, of sides 1.5 times as long


@pytest.mark.parametrize("wind_m_s", [1.0, 7.0])
def test_facets_are_as_small_as_the_glint_needs_however_small_the_planet_is_in_the_frame(wind_m_s):
    mesh = clouded(load_mesh(find_shape("globe"), RADIUS_M), Clouds(wind_m_s=wind_m_s), RADIUS_M)
    middles = mesh.vertices[mesh.faces].mean(axis=1)

    def lobe(places):  # of mirrors by their tilt, the Sun behind the eye
        cosine2 = np.maximum(places[..., 0] / np.linalg.norm(places, axis=-1), 1e-3) ** 2
        return np.exp((1 - 1 / cosine2) / (0.003 + 0.00512 * wind_m_s))

    wrong = np.abs(lobe(middles) - lobe(mesh.vertices)[mesh.faces].mean(axis=1))
    assert wrong.max() < 0.02 * 1.5**2 * 4 / 3  # in the middle of a facet a third more than on a side as long


def test_meshes_carry_water_through_every_change():
    mesh = clouded(load_mesh(find_shape("globe"), RADIUS_M), Clouds(seed=2), 8e5)
    shown = dataclasses.replace(mesh, albedo=2 * mesh.water)  # what happens to albedo happens to water
    for changed in (near_in_memory(shown), split_sides(shown, np.ones(shown.faces.shape, bool)), coarser(shown, 1.5e6)):
        assert changed is not shown
        np.testing.assert_allclose(changed.albedo, 2 * changed.water, rtol=1e-12)
    for smooth in (True, False):
        surface = lit_surface(shown, smooth=smooth)
        np.testing.assert_allclose(surface.albedo, 2 * surface.water, rtol=1e-12)


def test_water_comes_from_the_cache_too(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    globe = load_mesh(find_shape("globe"), RADIUS_M)
    made = detailed(globe, Clouds(), 1e5)
    monkeypatch.setattr("emulator.scene.bodies.regolith.clouded", None)
    np.testing.assert_array_equal(detailed(globe, Clouds(), 1e5).water, made.water)
    assert 0 < made.water.mean() < 1
