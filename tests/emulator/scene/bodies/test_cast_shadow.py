"""Covered shares of the Sun's disc: against fine sampling, closed forms, and a ray caster of others."""

import math

import numpy as np
import pytest
import trimesh

from emulator.scene.bodies.cast_shadow import build_tree, dim, edge_area, seen_above
from emulator.scene.bodies.lit_surface import lit_surface, shadow_triangles
from emulator.scene.bodies.mesh import build_mesh, find_shape, load_mesh

RADIUS = math.radians(0.2666)
TANGENT = math.tan(RADIUS)


def unit(v):
    return np.asarray(v, float) / np.linalg.norm(v)


def disc(count):
    """Return points spread evenly over the unit disc."""
    k = np.arange(count) + 0.5
    r, angle = np.sqrt(k / count), k * math.pi * (3 - math.sqrt(5))
    return r * np.cos(angle), r * np.sin(angle)


def sampled(tm, points, sun, count=200):
    """Return the share of the Sun's disc that each point sees, by rays of trimesh over embree."""
    u = unit(np.cross(sun, np.eye(3)[np.argmin(np.abs(sun))]))
    v = np.cross(sun, u)
    free = np.zeros(len(points))
    for x, y in zip(*disc(count), strict=True):
        ray = unit(sun + TANGENT * (x * u + y * v))
        free += ~tm.ray.intersects_any(points, np.tile(ray, (len(points), 1)))
    return free / count


def traced(tree, points, sun):
    moved = np.stack([np.column_stack([np.eye(3), np.zeros(3), sun])] * 2)
    shares = np.ones((2, len(points)))
    chosen = np.arange(len(points), dtype=np.int32)
    dim(tree, points, chosen, len(points), moved, TANGENT, 1e-7 * tree.radius_m, shares)
    return shares[0]


def joined(*parts):
    world = trimesh.util.concatenate(parts)
    return build_mesh(world.vertices, world.faces), world


def plane(points=4000):
    """Return places on the ground around the origin."""
    random = np.random.default_rng(5)
    return np.column_stack([random.uniform(-6, 6, (points, 2)), np.zeros(points)])


@pytest.mark.parametrize("x", [-0.999, -0.5, 0.0, 0.3, 0.98])
def test_a_straight_horizon_cuts_the_disc(x):
    _, y = disc(400_000)
    share, lift = seen_above(x)
    assert share == pytest.approx((y > -x).mean(), abs=1e-4)
    if share > 0.01:
        assert lift == pytest.approx(y[y > -x].mean(), abs=2e-3)


def test_the_part_of_the_disc_inside_a_polygon():
    random = np.random.default_rng(2)
    x, y = disc(40_000)
    for scale in (0.3, 1.0, 3.0, 1e4):
        for corners in random.normal(size=(30, 3, 2)) * scale:
            turned = np.roll(corners, -1, axis=0)
            area = sum(edge_area(*a, *b) for a, b in zip(corners, turned, strict=True))
            sides = [
                (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) > 0
                for a, b in zip(corners, turned, strict=True)
            ]
            inside = np.all(sides, axis=0) | ~np.any(sides, axis=0)
            assert abs(area) / math.pi == pytest.approx(inside.mean(), abs=2e-3)


@pytest.mark.system
@pytest.mark.parametrize("offset", [-1.2, -0.9, -0.4, 0.0, 0.5, 0.95, 1.5])
def test_the_step_shadow_of_a_wall_is_the_disc_s_share(offset):
    """A high wall from x = 0 on: the nearer edge hides the Sun from inside its shadow, the farther one from outside."""
    wall = build_mesh(*_box((0, 9.5, -50), (80, 10, 50)))
    tree = build_tree(shadow_triangles(wall))
    x = (9.5 if offset > 0 else 10.0) * TANGENT * offset
    shown = traced(tree, np.array([[x, 0.0, 0.0]]), (0.0, 1.0, 0.0))
    assert shown == pytest.approx(seen_above(-offset)[0], abs=1e-6)


def _box(low, high):
    box = trimesh.creation.box(bounds=[low, high])
    return box.vertices, box.faces


def test_an_eclipse_by_a_ball_is_two_circles_overlap():
    ball = trimesh.creation.icosphere(5, 1.0)
    ball.apply_translation((0, 0, 150.0))
    tree = build_tree(shadow_triangles(build_mesh(ball.vertices, ball.faces)))
    offsets, radius = np.linspace(0, 2, 9), math.tan(math.asin(1 / 150)) / TANGENT
    shown = traced(tree, np.outer(offsets, (150 * TANGENT, 0.0, 0.0)), (0.0, 0.0, 1.0))
    expected = [1 - _overlap(offset, radius, 1.0) / math.pi for offset in offsets]
    np.testing.assert_allclose(shown, expected, atol=4e-3)


def _overlap(d, r, R):
    """Area common to two circles: a textbook formula."""
    if d >= r + R:
        return 0.0
    if d <= abs(R - r):
        return math.pi * min(r, R) ** 2
    a = r * r * math.acos((d * d + r * r - R * R) / (2 * d * r))
    b = R * R * math.acos((d * d + R * R - r * r) / (2 * d * R))
    return a + b - 0.5 * math.sqrt((-d + r + R) * (d + r - R) * (d - r + R) * (d + r + R))


@pytest.mark.parametrize("shape", ["ball", "box", "sunk ball"])
@pytest.mark.parametrize("elevation_deg", [8.0, 40.0, 89.0])
def test_shadows_on_a_plane_do_not_leak(shape, elevation_deg):
    pytest.importorskip("embreex", reason="the ray caster of the test group")
    thrower = trimesh.creation.icosphere(4, 0.8) if shape != "box" else trimesh.creation.box((1.0, 2.0, 0.5))
    thrower.apply_translation((0.2, 0.1, 0.3 if shape == "sunk ball" else 1.2))
    mesh, world = joined(trimesh.creation.box(bounds=[(-9, -9, -1), (9, 9, -1e-9)]), thrower)
    tree, points = build_tree(shadow_triangles(mesh)), plane()
    points = points[~thrower.contains(points)]
    elevation = math.radians(elevation_deg)
    sun = np.array([math.cos(elevation) * 0.8, -math.cos(elevation) * 0.6, math.sin(elevation)])
    share, truth = traced(tree, points, sun), sampled(world, points + [0, 0, 1e-5], sun)
    assert (truth == 0).sum() > 5
    clear = (truth == 0) | (truth == 1)
    assert (np.abs(share - truth)[clear] > 0.1).mean() <= 0.001
    assert np.abs(share - truth)[~clear].sum() <= 0.02 * (~clear).sum()


@pytest.mark.parametrize("direction", [(0.25, -0.95, 0.15), (0.98, 0.1, -0.1)])
def test_eros_under_a_low_sun_does_not_leak(direction):
    pytest.importorskip("embreex", reason="the ray caster of the test group")
    mesh, sun = load_mesh(find_shape("eros007790"), 1.0), unit(direction)
    surface = lit_surface(mesh, smooth=True)
    lit = surface.normals @ sun > 0.01
    share = traced(build_tree(shadow_triangles(mesh)), surface.points[lit], sun)
    truth = sampled(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), surface.points[lit], sun)
    clear = (truth == 0) | (truth == 1)
    assert (truth == 0).sum() > 10
    assert (np.abs(share - truth)[clear] > 0.1).mean() <= 0.002
