"""Shadows as polygons on flat facets: areas in closed form, their rates, and light against point samples."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import trimesh

from emulator.geometry.camera import Pinhole
from emulator.photometry.reflectance import Glossy, Lambert, Sun
from emulator.scene.bodies.cast_shadow import build_tree
from emulator.scene.bodies.lit_surface import lit_surface, subdivide
from emulator.scene.bodies.mesh import load_mesh
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.shadow_polygons import Dark, SharpShadows, Surroundings, receivers_of
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.threads import ThreadPool
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.parameters import FixedPath, SpinPath
from emulator.trajectory.pose import STILL

CAMERA = Pinhole.of_field((96, 72), 30.0)
EYE = np.array([0.0, 0.0, 50.0])
MS = 1_000_000


@pytest.fixture(scope="module")
def shapes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shapes")
    trimesh.creation.box((20.0, 20.0, 0.1)).apply_translation((0, 0, -0.05)).export(folder / "plate.obj")
    trimesh.creation.box((2.0, 1.0, 1.5)).apply_translation((0, 0, 0.75)).export(folder / "box.obj")
    trimesh.creation.box((1.0, 3.0, 1.0)).apply_translation((1.0, 0, 2.0)).export(folder / "bar.obj")
    trimesh.creation.annulus(1.2, 1.4, 0.4, sections=48).apply_translation((0, 0, 2.0)).export(folder / "ring.obj")
    bars = [trimesh.creation.box(s).apply_translation((0, 0, 2.4)) for s in ((2.0, 0.3, 0.2), (0.3, 2.0, 0.2))]
    trimesh.util.concatenate(bars).export(folder / "cross.obj")
    return folder


def unit(*vector):
    return np.array(vector) / np.linalg.norm(vector)


def shadows(shapes, sun, *casters, turning=(0.0, 0.0, 0.0)):
    """Return the shadows that bodies throw on the plate z = 0, in the frame of all."""
    meshes = [load_mesh(shapes / f"{name}.obj", 1.0) for name in casters]
    tree = build_tree(np.concatenate([m.vertices[m.faces] for m in meshes]))
    plate = receivers_of(lit_surface(load_mesh(shapes / "plate.obj", 1.0), smooth=False), STILL)
    dark = Dark(np.full(200, 3.0), np.zeros(200))
    found = SharpShadows(0, tree, [plate], 1e-7).cast([dark], Surroundings(sun, np.asarray(turning, float), EYE))
    return found, plate


def areas(found, at_s=0.0):
    """Return the signed areas of the triangles in the plane, when their corners have moved on."""
    places = (found.corners[:, :3] + at_s * found.corners[:, 3:])[found.faces]
    e, f = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    return (e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]) / 2


def box_shadow(sun, size=(2.0, 1.0, 1.5)):
    """Return the area on the ground that a box hides, less its foot is not taken: a convex hexagon."""
    return size[0] * size[1] + size[2] * (size[0] * abs(sun[1]) + size[1] * abs(sun[0])) / sun[2]


def test_a_box_on_a_plate_hides_what_geometry_says(shapes):
    """Triangles that show the plate their outside are taken: the box's foot lies in the plate and hides nothing."""
    sun = unit(0.5, 0.3, 1.0)
    found, _ = shadows(shapes, sun, "box")
    assert (areas(found) > 0).all()
    beside = box_shadow(sun) - 2.0
    assert areas(found).sum() == pytest.approx(beside, rel=1e-5)
    assert np.abs(found.corners[:, 2]).max() < 1e-9
    assert found.radiance == pytest.approx(3.0)


def test_layers_are_cut_around_each_other(shapes):
    """The union of two shadows, by counting points of a fine grid in their convex outlines."""
    from scipy.spatial import Delaunay

    sun = unit(0.5, 0.1, 1.0)
    found, _ = shadows(shapes, sun, "box", "bar")
    axis = np.arange(1200) * 0.01 - 5.9963  # no line of points lies on a side
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    inside = np.zeros(len(grid), bool)
    for name in ("box", "bar"):
        points = load_mesh(shapes / f"{name}.obj", 1.0).vertices
        inside |= Delaunay(points[:, :2] - points[:, 2:] / sun[2] * sun[:2]).find_simplex(grid) >= 0
    foot = (np.abs(grid[:, 0]) < 1.0) & (np.abs(grid[:, 1]) < 0.5)
    bar = load_mesh(shapes / "bar.obj", 1.0).vertices
    cast_on_foot = foot & (Delaunay(bar[:, :2] - bar[:, 2:] / sun[2] * sun[:2]).find_simplex(grid) >= 0)
    truth = (inside & ~(foot & ~cast_on_foot)).sum() * 0.01**2
    assert areas(found).sum() == pytest.approx(truth, rel=0.01)


def covers(found, grid):
    """Return in how many triangles, 1e-5 m within their sides, each point of a plane lies."""
    count = np.zeros(len(grid), int)
    for a, b, c in found.corners[found.faces, :2]:
        inside = np.ones(len(grid), bool)
        for p, q in ((a, b), (b, c), (c, a)):
            way = q - p
            across = way[0] * (grid[:, 1] - p[1]) - way[1] * (grid[:, 0] - p[0])
            inside &= across > 1e-5 * np.linalg.norm(way)
        count += inside
    return count


@pytest.mark.parametrize("turn", [0.0, 0.3, 0.4, 0.5, 0.8])
def test_no_point_lies_in_two_shadows(shapes, turn):
    """A ring, whose sides and lower face cover each other, and whose triangles meet in corners of the shadow."""
    found, _ = shadows(shapes, unit(math.cos(turn), math.sin(turn), 1.0), "ring", "box", "cross")
    axis = np.arange(400) * 0.01 - 4.0003
    assert (covers(found, np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)) > 1).sum() == 0


def test_corners_move_as_the_sun_does(shapes):
    """The growth of the area from the corners' velocities is that between two places of the Sun."""
    turning = np.array([0.3, -0.2, 0.0])
    sun = unit(0.5, 0.1, 1.0)
    turning -= sun * (turning @ sun)
    found, _ = shadows(shapes, sun, "box", "bar", turning=turning)
    dt = 1e-5
    after, before = (areas(shadows(shapes, unit(*(sun + s * dt * turning)), "box", "bar")[0]).sum() for s in (1, -1))
    growth = (areas(found, dt).sum() - areas(found, -dt).sum()) / (2 * dt)
    assert abs(growth) > 0.3
    assert growth == pytest.approx((after - before) / (2 * dt), rel=1e-4)


@pytest.mark.parametrize(("threads", "parts"), [(1, 3), (2, 4), (3, 1)])
def test_threads_and_parts_change_no_bit(shapes, monkeypatch, threads, parts):
    meshes = [load_mesh(shapes / f"{name}.obj", 1.0) for name in ("ring", "cross")]
    tree = build_tree(np.concatenate([m.vertices[m.faces] for m in meshes]))
    fine = subdivide(load_mesh(shapes / "plate.obj", 1.0), 1.0)
    plate = receivers_of(lit_surface(fine, smooth=False), STILL)
    dark = Dark(np.linspace(1, 2, 4000), np.zeros(4000))
    around = Surroundings(unit(0.2, 0.1, 1.0), np.array([1e-3, 0, 0]), EYE)
    one = SharpShadows(0, tree, [plate, plate], 1e-7).cast([dark, dark], around)
    monkeypatch.setattr("emulator.scene.bodies.shadow_polygons._MOST_PARTS", parts)
    monkeypatch.setattr("emulator.scene.bodies.shadow_polygons._FIRST_ROWS", 16)  # less than there is to write
    pool = ThreadPool(threads)
    found = SharpShadows(0, tree, [plate, plate], 1e-7, pool).cast([dark, dark], around)
    pool.close()
    assert len(found.faces) > 500
    for name in ("corners", "radiance", "rate", "faces", "over"):
        np.testing.assert_array_equal(getattr(found, name), getattr(one, name))


def station(shapes, **more):
    def table(shape, **rest):
        return BodyTable(shape=str(shapes / f"{shape}.obj"), smooth=False, reflectance=Lambert(0.4), **rest)

    spin = SpinPath((0.0, 0.0, 25.0), (0.3, 0.4, -1.0), spin_deg_s=20.0, start_deg=150.0)
    still = FixedPath((0.0, 0.0, 0.0))
    bodies = (
        table("plate", name="plate", path=spin),
        table("box", fixed_to="plate", path=still),
        table("bar", fixed_to="plate", path=still),
    )
    return BodiesParameters(bodies=bodies, sun=Sun((-0.4, -0.5, -0.9)), ambient_w_m2=20.0, **more)


def drawn(scene, t_ns):
    light, rate = np.zeros((2, 72, 96), np.float32)
    scene.light_and_rate(t_ns, light, rate)
    return light.astype(float), rate.astype(float)


def rays_of(parameters, t_ns, side=8):
    """Return the mean light of side x side rays a pixel by embree, in the shadow or not: no facet is divided."""
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    pose = build_trajectory(parameters.bodies[0].path).pose(t_ns)
    parts = [load_mesh(Path(body.shape), 1.0) for body in parameters.bodies]
    mesh = trimesh.util.concatenate([trimesh.Trimesh(p.vertices, p.faces, process=False) for p in parts])
    caster = RayMeshIntersector(mesh)
    inner = (np.arange(72 * side) + 0.5) / side - 36, (np.arange(96 * side) + 0.5) / side - 48
    y, x = np.meshgrid(*inner, indexing="ij")
    ways = np.stack([x, y, np.full_like(x, CAMERA.focal_px)], axis=-1).reshape(-1, 3) @ pose.world_from_body
    eye = np.broadcast_to(-pose.position_m @ pose.world_from_body, ways.shape)
    places, rays, facets = caster.intersects_location(eye, ways, multiple_hits=False)
    normals, sun = mesh.face_normals[facets], unit(*parameters.sun.direction) @ pose.world_from_body
    free = ~caster.intersects_any(places + 1e-4 * normals, np.broadcast_to(sun, places.shape))
    lit = parameters.sun.irradiance_w_m2 * free * np.maximum(normals @ sun, 0)
    mu = -(normals * ways[rays]).sum(axis=1) / np.linalg.norm(ways[rays], axis=1)
    out = np.zeros(len(ways))
    out[rays] = 0.4 / math.pi * (lit + parameters.ambient_w_m2 * mu)
    return out.reshape(72, side, 96, side).mean(axis=(1, 3))


def test_light_at_shadow_edges_is_that_of_rays_and_its_rate_is_its_slope(shapes):
    pytest.importorskip("embreex", reason="the ray caster of the reference")
    parameters = station(shapes)
    truth = rays_of(parameters, 300 * MS)
    with RasterBodies(parameters, CAMERA) as body:
        light, _ = drawn(body, 300 * MS)
        (before, _), (_, rate), (after, _) = (drawn(body, t * MS) for t in (299, 300, 301))
    with RasterBodies(dataclasses.replace(parameters, shadows=False), CAMERA) as bare:
        lit, _ = drawn(bare, 300 * MS)
    mean = truth[truth > 0].mean()
    assert (lit - truth > 0.3 * mean).sum() > 50  # there is much shadow
    error = np.abs(light - truth)[truth > 0] / mean
    assert error.mean() < 0.004
    assert np.quantile(error, 0.99) < 0.06  # 8 x 8 rays are wrong by 3 % of an edge that lies along a side
    slope = (after - before) / 0.002
    assert np.abs(rate - slope).mean() < 0.01 * np.abs(slope).mean()


@pytest.mark.parametrize("size", [(96, 72), (960, 720)])
def test_facets_follow_the_highlight_not_the_size_of_the_picture(shapes, size):
    """Between corners the light is within the bound of that of the law, as a share of the highlight's height."""
    parameters = station(shapes)
    shiny = dataclasses.replace(parameters.bodies[0], reflectance=Glossy(0.04, 0.25, 100.0))
    parameters = dataclasses.replace(parameters, bodies=(shiny, *parameters.bodies[1:]))
    with RasterBodies(parameters, Pinhole.of_field(size, 30.0)) as body:
        plate = body._lit.surfaces[0]
    sides = plate.vertices[plate.faces] - plate.vertices[np.roll(plate.faces, 1, axis=1)]
    angle = np.linalg.norm(sides, axis=2).max() / body._world.arrangement.median_distance_m(
        0, body._world.meshes[0].vertices
    )
    assert 100.0 * angle**2 / 32 <= 0.01
    assert len(plate.faces) < 20_000
