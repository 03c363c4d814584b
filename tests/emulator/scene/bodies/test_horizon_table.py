"""Tables of horizons: walls in closed form, asteroids against a ray caster, what overhangs cost, the cache."""

import math

import numpy as np
import pytest
import trimesh

from emulator.scene.bodies import horizon_table as tables
from emulator.scene.bodies.cast_shadow import build_tree, seen_above
from emulator.scene.bodies.horizon_table import AZIMUTHS, dim_below, horizon_table, lost_light
from emulator.scene.bodies.lighting import LOST_AT_MOST
from emulator.scene.bodies.lit_surface import lit_surface, shadow_triangles
from emulator.scene.bodies.mesh import build_mesh, find_shape, load_mesh

RADIUS = math.radians(0.2666)
UP = np.array([[0.0, 0.0, 1.0]])


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "evstim"


def unit(v):
    return np.asarray(v, float) / np.linalg.norm(v)


def share(table, normals, sun):
    chosen = np.arange(len(normals), dtype=np.int32)
    cosines, shares = np.stack([normals @ sun] * 2), np.empty((2, len(normals)))
    dim_below(table, normals, chosen, len(normals), np.stack([sun, sun]), RADIUS, cosines, shares)
    return shares[0]


def wall(low, high):
    box = trimesh.creation.box(bounds=[low, high])
    return build_tree(shadow_triangles(build_mesh(box.vertices, box.faces)))


def ray_cast(mesh, points, sun, count=100):
    k = np.arange(count) + 0.5
    r, angle = np.sqrt(k / count) * math.tan(RADIUS), k * math.pi * (3 - math.sqrt(5))
    u = unit(np.cross(sun, np.eye(3)[np.argmin(np.abs(sun))]))
    v = np.cross(sun, u)
    tm = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    free = np.zeros(len(points))
    for x, y in zip(r * np.cos(angle), r * np.sin(angle), strict=True):
        free += ~tm.ray.intersects_any(points, np.tile(unit(sun + x * u + y * v), (len(points), 1)))
    return free / count


@pytest.mark.parametrize("azimuth_deg", [0.0, 13.0, 90.0, 211.0, 359.0])
@pytest.mark.parametrize("above", [-1.1, -0.5, 0.0, 0.5, 1.1])
def test_a_ring_wall_hides_the_disc_s_share(azimuth_deg, above):
    """A round wall of 2000 sides, 10 m away and 3 m high: the same horizon everywhere."""
    angle = np.arange(2000) * 2 * math.pi / 2000
    rim = np.column_stack([10 * np.cos(angle), 10 * np.sin(angle)])
    low, high = (np.column_stack([rim, np.full(2000, z)]) for z in (-1.0, 3.0))
    k = np.arange(2000)
    after = (k + 1) % 2000
    faces = np.concatenate([np.column_stack([k, after + 2000, after]), np.column_stack([k, k + 2000, after + 2000])])
    tree = build_tree(shadow_triangles(build_mesh(np.concatenate([low, high]), faces)))
    table = horizon_table(tree, np.zeros((1, 3)), UP)
    assert table.shape == (1, AZIMUTHS)
    elevation, azimuth = math.atan(0.3) + above * RADIUS, math.radians(azimuth_deg)
    sun = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    assert share(table, UP, sun)[0] == pytest.approx(seen_above(above)[0], abs=3e-3)


def test_a_wall_s_end_is_right_to_the_spacing_and_a_penumbra_wide():
    """The Sun goes behind the upright edge of a tower: no step, and the ramp is about as wide as the disc."""
    tree = wall((10, 0, -1), (11, 60, 90))
    table = horizon_table(tree, np.zeros((1, 3)), UP)
    azimuths = np.radians(np.arange(-10, 10, 0.01))
    seen = [share(table, UP, unit([math.cos(a), math.sin(a), 0.4]))[0] for a in azimuths]
    assert seen[0] == 1
    assert seen[-1] == 0
    assert np.abs(np.diff(seen)).max() < 0.05
    partly = np.degrees(azimuths[(np.array(seen) > 0) & (np.array(seen) < 1)])
    assert 0.3 < np.ptp(partly) < 2.2
    assert abs(partly.mean()) < 7.2


@pytest.mark.system
@pytest.mark.parametrize(
    ("shape", "direction"),
    [("eros022540", (0.25, -0.95, 0.15)), ("eros007790", (0.98, 0.1, -0.1)), ("itokawa_49152", (0.9, 0.3, 0.2))],
)
def test_asteroids_have_the_shadows_of_a_ray_caster(shape, direction):
    pytest.importorskip("embreex", reason="the ray caster of the test group")
    mesh, sun = load_mesh(find_shape(shape), 1000.0), unit(direction)
    surface = lit_surface(mesh, smooth=True)
    lit = np.flatnonzero(surface.normals @ sun > 0.01)[::3]
    tree = build_tree(shadow_triangles(mesh))
    points, normals = surface.points[lit], surface.normals[lit]
    table = horizon_table(tree, points, normals)
    found, truth = share(table, normals, sun), ray_cast(mesh, points, sun)
    clear = (truth == 0) | (truth == 1)
    wrong = clear & (np.abs(found - truth) > 0.5)
    assert (truth == 0).sum() > 10
    assert wrong.sum() / clear.sum() <= 0.01
    assert lost_light(tree, points, normals, table, math.tan(RADIUS)) < 0.001
    # what is wrong is so within the spacing of azimuths: the truth there is another one for a Sun that stands as near
    turned = []
    for angle in np.radians([-7.2, -3.6, 3.6, 7.2]):
        for axis in normals[wrong], np.cross(normals[wrong], sun):
            suns = sun * math.cos(angle) + np.cross(axis, sun) * math.sin(angle)
            turned += [[ray_cast(mesh, points[wrong][k : k + 1], unit(s), 1)[0] for k, s in enumerate(suns)]]
    if wrong.any():
        nearby = np.array(turned)
        assert (np.abs(nearby - found[wrong]).min(axis=0) <= 0.5).all()


def test_light_below_an_overhang_is_lost_and_measured():
    ground = trimesh.creation.box(bounds=[(-9, -9, -1), (9, 9, 0)])
    ball = trimesh.creation.icosphere(3, 1.0)
    ball.apply_translation((0, 0, 3.0))
    both = trimesh.util.concatenate([ground, ball])
    tree = build_tree(shadow_triangles(build_mesh(both.vertices, both.faces)))
    points = np.random.default_rng(1).uniform(-3, 3, (200, 3)) * [1, 1, 0] + [0, 0, 1e-4]
    normals = np.tile(UP, (200, 1))
    table = horizon_table(tree, points, normals)
    assert lost_light(tree, points, normals, table, math.tan(RADIUS)) > 5 * LOST_AT_MOST


def test_a_convex_body_throws_no_shadow_on_itself():
    ball = trimesh.creation.icosphere(4, 1.0)
    surface = lit_surface(build_mesh(ball.vertices, ball.faces), smooth=True)
    tree = build_tree(shadow_triangles(build_mesh(ball.vertices, ball.faces)))
    assert horizon_table(tree, surface.points, surface.normals).max() < 65535 * 0.02


def test_a_table_is_made_once(cache, monkeypatch, capsys):
    tree, point = wall((10, -5, -1), (11, 5, 4)), np.zeros((1, 3))
    first = horizon_table(tree, point, UP, "a wall")
    assert "horizons of a wall: 100 %" in capsys.readouterr().err
    monkeypatch.setattr(tables, "_make", lambda *_: pytest.fail("made again"))
    np.testing.assert_array_equal(horizon_table(tree, point, UP, "a wall"), first)
    assert len(list(cache.glob("horizons-*.npy"))) == 1
    with pytest.raises(pytest.fail.Exception):
        horizon_table(tree, point + 1e-9, UP, "a wall")


def test_points_without_a_sound_normal_have_no_horizon():
    tree = wall((10, -5, -1), (11, 5, 4))
    normals = np.array([[np.nan, 0, 1], [0, 0, 0], [0, 0, 1.0]])
    table = horizon_table(tree, np.zeros((3, 3)), normals)
    assert (table[:2] == 0).all()
    assert table[2].max() > 0
    assert np.isfinite(share(table, normals, unit([1, 0, 0.1]))[1:]).all()
