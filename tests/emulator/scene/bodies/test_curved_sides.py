"""Sides cut on their curves: points on a ball, where they are cut, and the light of a ball against its closed form."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh

from emulator.geometry.camera import Pinhole
from emulator.photometry.reflectance import Lambert, Sun
from emulator.scene.bodies import curved_sides, raster_bodies
from emulator.scene.bodies.curved_sides import cached_thirds, mark, with_thirds
from emulator.scene.bodies.lit_surface import near_in_memory
from emulator.scene.bodies.mesh import build_mesh
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.sun_rays import Window
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.trajectory.parameters import FixedPath


def ball(subdivisions=3):
    made = trimesh.creation.icosphere(subdivisions=subdivisions)
    mesh = build_mesh(made.vertices, made.faces)
    return dataclasses.replace(mesh, normals=mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True))


def test_both_facets_of_a_side_have_its_points_in_order():
    mesh = ball(1)
    surface, sides, fine = with_thirds(mesh, 1e-4)
    for k in range(3):
        ends = mesh.vertices[mesh.faces[:, k]], mesh.vertices[np.roll(mesh.faces, -1, axis=1)[:, k]]
        for j in range(2):
            share = (1 + j) / 3
            chord = (1 - share) * ends[0] + share * ends[1]
            np.testing.assert_allclose(fine.vertices[sides.between[:, 2 * k + j]], chord, atol=0.05)
    assert len(np.unique(sides.between)) == len(sides.bends_m) == len(surface.points) - len(mesh.vertices)


@pytest.mark.parametrize("bend_px", [0.03, 10.0])
def test_facets_with_a_shadow_edge_are_cut(bend_px):
    mesh = ball()
    surface, sides, _ = with_thirds(mesh, 1e-4)
    eye = np.array([0.0, 0.0, -50.0])
    window = Window(np.eye(3), eye, 1.0, 1.0, bend_px * 49.0 / np.median(sides.bends_m[sides.bends_m > 0]))
    hidden, marked = np.zeros(len(surface.points), np.int8), np.ones(len(surface.points), np.uint8)
    front = np.argmin(mesh.vertices[:, 2])
    for known in (0, -1):
        hidden[:] = known
        hidden[front] = 1
        args = np.array([0.0, 0.0, -1.0]), window, hidden, np.empty((3, len(marked)))
        mark(surface.points, surface.normals, sides, *args, marked)
        around = (mesh.faces == front).any(axis=1) & (known == 0)
        assert (marked[sides.between[around]] == 1).all()
        others = np.setdiff1d(sides.between[(surface.normals[mesh.faces, 2] < -0.8).all(axis=1)], sides.between[around])
        assert len(others) > 50
        assert not marked[others].any()


@pytest.mark.parametrize(
    ("sun", "eye"), [((1.0, 0.0, 0.0), (0.0, 0.0, -50.0)), ((0.2, 0.5, -0.8), (30.0, 10.0, -40.0))]
)
def test_sides_are_cut_at_the_terminator_and_on_the_lit_outline(sun, eye):
    sun, eye = np.array(sun) / np.linalg.norm(sun), np.array(eye)
    surface, sides, _ = with_thirds(ball(), 1e-4)
    whole = len(surface.points) - len(sides.bends_m)
    marked = np.ones(len(surface.points), np.uint8)
    forward = -eye / np.linalg.norm(eye)
    across = np.cross(forward, [0.0, 1.0, 0.0])
    turn = np.stack([across / np.linalg.norm(across), np.cross(forward, across), forward])
    window = Window(turn, eye, 1.0, 1.0, 1e5)
    unknown, room = np.full(len(marked), -1, np.int8), np.empty((3, len(marked)))
    mark(surface.points, surface.normals, sides, sun, window, unknown, room, marked)
    middles = surface.vertices[whole:]
    towards = (eye - middles) / np.linalg.norm(eye - middles, axis=1, keepdims=True)
    incidence, emission = middles @ sun, (middles * towards).sum(axis=1)
    at_terminator = (incidence > 0) & (incidence < 0.05) & (emission > 0.0)
    towards = eye - surface.vertices[:whole]
    faces_camera = ((surface.vertices[:whole] * towards).sum(axis=1) > 0)[surface.faces]
    on_outline = faces_camera.any(axis=1) & ~faces_camera.all(axis=1)
    on_outline &= (surface.vertices[surface.faces] @ sun > 0.0).any(axis=1)
    far = ((np.abs(incidence) > 0.4) & (np.abs(emission) > 0.4)) | (emission < -0.4)
    is_cut = marked[whole:] == 1
    assert at_terminator.sum() > 50
    assert is_cut[at_terminator].all()
    assert on_outline.sum() > 40
    assert (marked[sides.between[on_outline]] == 1).all()
    assert far.sum() > 500
    assert not is_cut[far].any()
    seen = faces_camera.any(axis=1)
    assert not marked[np.setdiff1d(sides.between[~seen], sides.between[seen])].any()
    window = window._replace(focal_px=0.039 * 48.0 / sides.bends_m.max())  # no bend is seen, but at shadow edges
    mark(surface.points, surface.normals, sides, sun, window, unknown, room, marked)
    assert not marked[whole:].any()


def picture(tmp_path, size, monkeypatch, bend_px):
    file = tmp_path / "ball.obj"
    if not file.exists():
        trimesh.creation.icosphere(subdivisions=3).export(file)
    monkeypatch.setattr(raster_bodies, "BEND_PX", bend_px)
    parameters = BodiesParameters(
        bodies=(BodyTable(shape=str(file), path=FixedPath(), reflectance=Lambert(1.0), smooth=True),),
        camera=FixedPath((0.0, 0.0, -50.0)),
        sun=Sun(direction=(1.0, 0.2, 0.3)),
        detail_px=0.0,
    )
    light = np.zeros((size, size), np.float32)
    with RasterBodies(parameters, Pinhole(size, size, 0.5 * size / 0.0215)) as scene:
        scene.light(0, light)
    return light


def closed_form(size, samples=8):
    """Return the light of the ball by points of each pixel."""
    side = (np.arange(size * samples) + 0.5) / samples
    x, y = np.meshgrid((side - size / 2) * 0.0215 / (0.5 * size), (side - size / 2) * 0.0215 / (0.5 * size))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    a, b = (rays**2).sum(axis=-1), -50.0 * rays[..., 2]
    root = b * b - a * (50.0**2 - 1)
    hit = root > 0
    t = (-b - np.sqrt(np.where(hit, root, 0))) / a
    places = np.array([0.0, 0.0, -50.0]) + t[..., None] * rays
    sun = np.array([1.0, 0.2, 0.3]) / np.linalg.norm([1.0, 0.2, 0.3])
    light = np.where(hit, np.maximum(places @ sun, 0), 0)
    return light.reshape(size, samples, size, samples).mean(axis=(1, 3)) * Sun().irradiance_w_m2 / math.pi


def test_the_light_of_a_ball_is_that_of_its_closed_form(tmp_path, monkeypatch):
    """With its sides cut and without: light falls to 0 at the terminator, not at the next vertex beyond it."""
    truth, size = closed_form(120), 120
    dim = (truth > 0) & (truth < 0.1 * truth.max())  # along the terminator and the outline
    for bend_px, rms in ((0.05, 5e-3), (1e9, 1e-2)):
        wrong = picture(tmp_path, size, monkeypatch, bend_px) - truth
        assert math.sqrt(float((wrong[dim] ** 2).mean())) / truth.max() < rms
        assert abs(wrong[dim].sum()) < 0.03 * truth[dim].sum()
        assert wrong[truth == 0].sum() < 1e-3 * truth[dim].sum()


def test_thirds_of_a_large_mesh_are_made_once(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(curved_sides, "_CACHED_FACETS", 1000)
    mesh = ball()
    mesh = dataclasses.replace(mesh, albedo=mesh.vertices[mesh.faces, 0] + 2.0)
    expected = with_thirds(near_in_memory(mesh), 1e-4)
    cached_thirds(mesh, 1e-4)
    monkeypatch.setattr(curved_sides, "with_thirds", None)
    for found, wanted in zip(cached_thirds(mesh, 1e-4), expected, strict=True):
        names = (
            [field.name for field in dataclasses.fields(wanted)] if dataclasses.is_dataclass(wanted) else wanted._fields
        )
        for name in names:
            values = getattr(found, name), getattr(wanted, name)
            assert type(values[0]) is type(values[1]), name
            np.testing.assert_array_equal(*values, err_msg=name)
            assert not isinstance(values[0], np.ndarray) or values[0].flags.c_contiguous
    for other in ((mesh, 2e-4), (dataclasses.replace(mesh, albedo=None), 1e-4), (ball(4), 1e-4)):
        with pytest.raises(TypeError):
            cached_thirds(*other)
