"""Grain: its noise against another library, closed forms of a wave on a plane, the truth by rays, and its rate."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from emulator.geometry.camera import Pinhole
from emulator.light import Region
from emulator.photometry.reflectance import Lambert, Sun
from emulator.photometry.reflection_kernels import law_of
from emulator.raster.layout import Screen, View
from emulator.raster.renderer import Renderer
from emulator.raster.topology import prepare
from emulator.scene.bodies.grain import (
    TEXELS,
    GrainLayer,
    Ground,
    Octaves,
    crater_tile,
    look_up,
    noise_tile,
    octaves,
    on_facets,
    placed,
    write_heights,
)
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.table import BodiesParameters, BodyTable, Clouds, Regolith
from emulator.sensor.numerics.compiled import kernel
from emulator.trajectory.parameters import FixedPath, SpinPath

SIDE = 32


@kernel
def _look(fields, place, drift, out):
    values = look_up(fields, (place[0], place[1], place[2]), (drift[0], drift[1], drift[2]))
    for k in range(8):
        out[k] = values[k]


def test_the_noise_and_its_rate_are_those_of_another_library():
    rng = np.random.default_rng(3)
    fields = crater_tile().reshape(SIDE, SIDE, SIDE, 4)
    out, drift, h = np.empty(8), np.array([0.3, -0.7, 0.2]), 1e-3
    for place in rng.uniform(-30, 30, (50, 3)):
        if np.abs((place * TEXELS) % 1 - 0.5).max() > 0.49:
            continue  # too near to a texel, where the rate has a step
        _look(crater_tile(), place, drift, out)
        around = TEXELS * (place + np.outer([0, -h, h], drift)).T
        true = np.array([map_coordinates(fields[..., k], around, np.float64, 1, "grid-wrap") for k in range(4)])
        np.testing.assert_allclose(out[:4], true[:, 0], atol=1e-4)
        np.testing.assert_allclose(out[4:], (true[:, 2] - true[:, 1]) / (2 * h), rtol=0.01, atol=0.02)


def test_finer_facets_carry_more_of_the_same_surface():
    of_all = octaves(80.0, 1.0, 0.5, 4, noise_tile())
    coarse, fine = (on_facets(of_all, 0.1, 0.01, 10.0, facet_m) for facet_m in (10.0, 2.5))
    np.testing.assert_array_equal(coarse.heights_m, fine.heights_m)
    np.testing.assert_array_equal(coarse.shifts, fine.shifts)
    assert (fine.on_facets >= coarse.on_facets).all()
    assert fine.on_facets[2:4].tolist() == [1.0, 1.0]
    assert coarse.on_facets[2:].tolist() == [0.0] * 5
    points = np.random.default_rng(1).uniform(-300, 300, (50_000, 3))
    height = np.empty(len(points))
    write_heights(points, fine, height)
    between = 0.93  # straight lines between texels are flatter
    assert height.std() == pytest.approx(between * np.linalg.norm(fine.on_facets * fine.heights_m), rel=0.04)


SUN_W_M2, ALBEDO, FOCAL_PX, WIDTH, HEIGHT = 1000.0, 0.3, 100.0, 48, 32
TILT = np.array([[1.0, 0.0, 0.0], [0.0, math.cos(0.6), -math.sin(0.6)], [0.0, math.sin(0.6), math.cos(0.6)]])
PLACE_M = np.array([0.3, -0.2, 10.0])
TO_SUN = np.array([0.5, 0.3, -0.8]) / np.linalg.norm([0.5, 0.3, -0.8])  # in the frame of the plane, z away from it
WAVE_M, HEIGHT_M = 3.0, 0.36


def waves():
    """Return a tile with the height sin along x, four wavelengths of `tile` long."""
    phase = np.broadcast_to(2 * math.pi * np.arange(SIDE)[:, None, None] / SIDE, 3 * (SIDE,)).ravel()
    zero = np.zeros(len(phase))
    return np.stack([math.pi / 2 * np.cos(phase), zero, zero, np.sin(phase)], axis=1).astype(np.float32)


def plane_with_waves(shift_m, velocity_m_s, layer_threads=1):
    """Return light and rate of a plane with the waves, that has moved by `shift_m` and moves on."""
    corners = np.array([[-14.0, -8, 0], [0, 14, 0], [14, -8, 0]])
    at_m = PLACE_M + shift_m
    renderer = Renderer(
        prepare([[0, 1, 2]], two_sided=True), Screen(WIDTH, HEIGHT, FOCAL_PX, (WIDTH / 2, HEIGHT / 2), 1e-3)
    )
    mu0 = -TO_SUN[2]
    flat = np.full(3, ALBEDO / math.pi * mu0)
    layer_of = Octaves(np.array([WAVE_M]), np.array([HEIGHT_M]), np.zeros(1), np.zeros(1), np.zeros((1, 3)), waves())
    normals = np.tile([0.0, 0.0, -1.0], (3, 1))
    law = law_of(Lambert(albedo=ALBEDO))
    ground = Ground(0, normals, np.ones(3), layer_of, law, SUN_W_M2)
    layer = GrainLayer({0: [ground]}, (WIDTH, HEIGHT), layer_threads)
    light, rate = np.zeros((2, HEIGHT, WIDTH), np.float32)
    view = View(corners @ TILT.T + at_m, np.tile(velocity_m_s, (3, 1)), SUN_W_M2 * flat, np.zeros(3))
    renderer.draw(view, light, rate, None, layer.owners)
    motion = np.column_stack([np.zeros((3, 3)), velocity_m_s])
    place = placed(TILT, at_m, motion, TO_SUN, Pinhole(WIDTH, HEIGHT, FOCAL_PX))
    layer.add(renderer, {0: place}, Region(0, HEIGHT, 0, WIDTH), light, rate)
    renderer.close()
    layer.close()
    return light.astype(float), rate.astype(float)


def closed_form(shift_m, points=12):
    """Return the mean of Lambert's law over each pixel, with the slope of the sine in closed form."""
    within = (np.arange(points) + 0.5) / points
    x = (np.arange(WIDTH)[:, None] + within).ravel() - WIDTH / 2
    y = (np.arange(HEIGHT)[:, None] + within).ravel() - HEIGHT / 2
    rays = np.stack([*np.meshgrid(x / FOCAL_PX, y / FOCAL_PX), np.ones((len(y), len(x)))], axis=2)
    upright, at_m = TILT[:, 2], PLACE_M + shift_m
    hits = rays * (at_m @ upright / (rays @ upright))[..., None]
    along = (hits - at_m) @ TILT[:, 0]
    slope = 2 * math.pi / (4 * WAVE_M) * HEIGHT_M * np.cos(2 * math.pi * along / (4 * WAVE_M))
    mu0 = np.maximum(-TO_SUN[2] - slope * TO_SUN[0], 0) / np.sqrt(1 + slope**2)
    fine = SUN_W_M2 * ALBEDO / math.pi * mu0
    return fine.reshape(HEIGHT, points, WIDTH, points).mean(axis=(1, 3))


def test_a_wave_on_a_plane_is_lit_by_its_closed_form():
    light, _ = plane_with_waves(np.zeros(3), np.zeros(3))
    true = closed_form(np.zeros(3))
    assert true.std() > 0.03 * true.mean()
    np.testing.assert_allclose(light, true, rtol=0.003)


def test_its_rate_is_the_derivative_of_the_closed_form():
    velocity, h = np.array([0.7, -0.4, 1.5]), 1e-3
    _, rate = plane_with_waves(np.zeros(3), velocity)
    true = (closed_form(h * velocity) - closed_form(-h * velocity)) / (2 * h)
    steps = math.pi / SIDE  # between texels slopes are straight lines, and their rates constant
    np.testing.assert_allclose(rate, true, atol=(steps + 0.005) * np.abs(true).max())
    assert np.corrcoef(rate.ravel(), true.ravel())[0, 1] > 0.995


def test_grain_is_the_same_with_any_number_of_threads():
    one, three = (plane_with_waves(np.zeros(3), np.array([1.0, 0, 0]), threads) for threads in (1, 3))
    np.testing.assert_array_equal(one, three)


GROUND = Regolith(
    seed=5,
    boulders_km2=0.0,
    craters=0.0,
    slope_deg=6.0,
    albedo_rms=0.1,
    smooth_share=0.0,
    facet_px=1.5,
    most_facets=1300,
)


def rough_ball(detail=GROUND):
    """Return a turning ball of 642 vertices in sunlight from the side, and a camera before it."""
    body = BodyTable(
        shape="globe",
        units_m=300.0,
        path=SpinPath(pole=(0.0, 1.0, 0.0), spin_deg_s=20.0),
        reflectance=Lambert(albedo=ALBEDO),
        detail=detail,
    )
    camera = FixedPath(position_m=(0.0, 0.0, -1500.0))
    return BodiesParameters(camera=camera, sun=Sun(direction=(0.8, 0.2, -0.6)), bodies=(body,)), Pinhole(
        128, 128, 280.0
    )


def drawn(parameters, pinhole, t_ns=0):
    scene = RasterBodies(parameters, pinhole)
    light, rate = np.zeros((2, pinhole.height, pinhole.width), np.float32)
    scene.light_and_rate(t_ns, light, rate)
    scene.close()
    return light.astype(float), rate.astype(float)


def test_a_ball_with_grain_is_lit_as_by_rays():
    pytest.importorskip("embreex", reason="the truth casts rays by embree")
    from laboratory.accuracy.sampled_scenes import SampledBodies

    parameters, pinhole = rough_ball()
    light, _ = drawn(parameters, pinhole)
    true = np.zeros((128, 128), np.float32)
    SampledBodies(parameters, pinhole, 8).light(0, true)
    even, _ = drawn(*rough_ball(dataclasses.replace(GROUND, slope_deg=0.0, albedo_rms=0.0)))
    lit = (true > 0.2 * true.max()) & (even > 0)
    error, grain = np.log(light[lit] / true[lit]), np.log(even[lit] / true[lit])
    assert lit.sum() > 4000
    assert grain.std() > 0.05
    assert error.std() < 0.08 * grain.std()


def test_clouds_below_facets_are_lit_as_by_rays(monkeypatch):
    pytest.importorskip("embreex", reason="the truth casts rays by embree")
    from laboratory.accuracy.sampled_scenes import SampledBodies

    parameters, pinhole = rough_ball(Clouds(seed=3, facet_px=16.0))
    true = np.zeros((128, 128), np.float32)
    SampledBodies(parameters, pinhole, 8).light(0, true)
    fine, _ = drawn(parameters, pinhole)
    monkeypatch.setattr("emulator.scene.bodies.world.cloud_grain", lambda *_: None)
    even, _ = drawn(parameters, pinhole)
    lit = true > 0.2 * true.max()
    error, grain = np.log(fine[lit] / true[lit]), np.log(even[lit] / true[lit])
    assert lit.sum() > 2500
    assert grain.std() > 0.1
    assert error.std() < 0.4 * grain.std()  # air above clouds is not part of the truth's clouds


def test_the_rate_of_a_turning_ball_with_grain_is_that_of_its_light():
    parameters, pinhole = rough_ball()
    h_ns = 500_000
    before, _ = drawn(parameters, pinhole, 10**9 - h_ns)
    light, rate = drawn(parameters, pinhole, 10**9)
    after, _ = drawn(parameters, pinhole, 10**9 + h_ns)
    lit = light > 0.2 * light.max()
    assert np.corrcoef(rate[lit], ((after - before) / (2e-9 * h_ns))[lit])[0, 1] > 0.99
