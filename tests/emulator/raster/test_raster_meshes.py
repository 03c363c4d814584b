"""Curved bodies against rays of an independent tracer."""

import numpy as np
import pytest
import trimesh

from emulator.raster.layout import Screen, View
from emulator.raster.renderer import Renderer
from emulator.raster.topology import join, prepare

SCREEN = Screen(64, 48, 300.0, (32.0, 24.0))
SPIN = np.array([0.3, 0.9, -0.2])


def bumpy(subdivisions):
    """Return a sphere of about 1 m with deep bumps: it hides parts of itself."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    p = ball.vertices
    radius = 1 + 0.18 * np.sin(5 * p[:, 0] + 1) * np.cos(4 * p[:, 1]) + 0.12 * np.sin(7 * p[:, 2])
    return p * radius[:, None], np.asarray(ball.faces, np.int32)


def turned(points, t):
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(SPIN * t).apply(points)


def view_of(points, place, t):
    here = turned(points, t)
    across = points[:, 0] / np.abs(points).max()
    return View(here + place, np.cross(SPIN, here), 1.0 + 0.5 * across, np.zeros(len(points)))


@pytest.mark.system
@pytest.mark.parametrize(("subdivisions", "range_m"), [(2, 16.0), (4, 16.0), (4, 90.0)])
def test_light_of_a_bumpy_ball(picture, trace, subdivisions, range_m):
    points, faces = bumpy(subdivisions)
    place = np.array([0.013, -0.021, range_m])
    view = view_of(points, place, 0.4)
    light, _, _ = picture(Renderer(prepare(faces), SCREEN), view)
    truth = trace(SCREEN, view.positions_m, faces, view.radiance, 32)
    mean = truth[truth > 0].mean()
    error = np.abs(light - truth)[truth > 0] / mean
    assert np.median(error) < 1e-3
    assert np.percentile(error, 99) < 0.02
    assert light.sum() == pytest.approx(truth.sum(), rel=1e-3)
    assert not light[truth == 0].max() > 0.01 * mean


def test_rate_of_a_bumpy_ball_is_the_slope_of_its_light(picture):
    """The outline of a turning ball hardly moves: rays would need a million a pixel; light itself is judged above."""
    points, faces = bumpy(4)
    place, step = np.array([0.0, 0.0, 16.0]), 5e-4
    renderer = Renderer(prepare(faces), SCREEN)

    def at(t):
        light, rate, _ = picture(renderer, view_of(points, place, t))
        return light.astype(float), rate

    slope = (at(0.4 + step)[0] - at(0.4 - step)[0]) / (2 * step)
    error = np.abs(at(0.4)[1] - slope)[slope != 0] / np.sqrt((slope[slope != 0] ** 2).mean())
    assert np.median(error) < 1e-3
    assert np.percentile(error, 99) < 0.01


def test_bodies_from_a_tenth_of_a_metre_to_a_tenth_of_a_million_kilometres(picture):
    points, faces = bumpy(3)
    scales, places = (0.004, 1.0, 2e7), ([-0.008, 0, 0.1], [-0.5, 0, 25.0], [0, -5.3e7, 1e9])
    views = [view_of(points * s, np.array(p), 0.4) for s, p in zip(scales, places, strict=True)]
    fields = ("positions_m", "velocities_m_s", "radiance", "radiance_rate")
    together = View(*(np.concatenate([getattr(v, f) for v in views]) for f in fields))
    light, _, _ = picture(Renderer(join([prepare(faces)] * 3), SCREEN), together)
    alone = [picture(Renderer(prepare(faces), SCREEN), v)[0] for v in views]
    on = [one > 0 for one in alone]
    for k, one in enumerate(alone):
        only = on[k] & ~np.logical_or.reduce([on[j] for j in range(3) if j != k])
        assert only.any()
        np.testing.assert_allclose(light[only], one[only], atol=1e-6)
    whole = (alone[0] > 0) & (np.roll(alone[0], 2, 0) > 0) & (np.roll(alone[0], -2, 0) > 0)
    whole &= (np.roll(alone[0], 2, 1) > 0) & (np.roll(alone[0], -2, 1) > 0)
    assert (whole & on[1]).any()
    np.testing.assert_allclose(light[whole], alone[0][whole], atol=1e-5)


@pytest.mark.long
@pytest.mark.system
def test_balls_that_pass_through_each_other(picture, trace):
    points, faces = bumpy(3)
    places = np.array([-0.4, 0, 16.0]), np.array([0.4, 0.1, 16.3])
    views = [view_of(points, p, 0.4) for p in places]
    both = np.concatenate([v.positions_m for v in views])
    speeds = np.concatenate([v.velocities_m_s for v in views])
    radiance = np.concatenate([np.full(len(points), 1.0), np.full(len(points), 2.0)])
    view = View(both, speeds, radiance, np.zeros(len(both)))
    all_faces = np.concatenate([faces, faces + len(points)])
    light, rate, _ = picture(Renderer(join([prepare(faces)] * 2), SCREEN), view)
    truth = trace(SCREEN, both, all_faces, radiance, 32)
    error = np.abs(light - truth)[truth > 0]
    assert np.median(error) < 1e-3
    assert np.percentile(error, 99) < 0.03
    step = 0.005
    after, before = (trace(SCREEN, both + s * step * speeds, all_faces, radiance, 64) for s in (1, -1))
    slope = (after - before) / (2 * step)
    error = np.abs(rate - slope)[truth > 0] / np.sqrt((slope[truth > 0] ** 2).mean())
    assert np.median(error) < 0.01
    assert np.percentile(error, 95) < 0.15  # lines cannot be laid across a curve that no edge tells of
