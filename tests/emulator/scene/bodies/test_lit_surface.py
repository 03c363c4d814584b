"""Points to be lit: subdivision without gaps, corners in one plane that share a radiance."""

import numpy as np
import pytest
import trimesh

from emulator.scene.bodies.lit_surface import lit_surface, subdivide
from emulator.scene.bodies.mesh import build_mesh
from tests.emulator.scene.bodies.volume import volume_m3


def box(size=(3.0, 1.0, 0.2)):
    made = trimesh.creation.box(size)
    return build_mesh(made.vertices, made.faces)


@pytest.mark.parametrize("size_m", [5.0, 0.7, 0.11])
@pytest.mark.parametrize("make", [box, lambda: build_mesh(*_ball())])
def test_subdivision_keeps_the_surface_and_leaves_no_gap(make, size_m):
    mesh = make()
    fine = subdivide(mesh, size_m)
    sides = fine.vertices[fine.faces] - fine.vertices[np.roll(fine.faces, 1, axis=1)]
    assert np.linalg.norm(sides, axis=2).max() <= size_m
    assert build_mesh(fine.vertices, fine.faces).open_edges == 0  # it also refuses facets of different winding
    assert len(build_mesh(fine.vertices, fine.faces).vertices) == len(fine.vertices)
    assert fine.area_m2 == pytest.approx(mesh.area_m2, rel=1e-12)
    assert volume_m3(fine) == pytest.approx(volume_m3(mesh), rel=1e-12)
    np.testing.assert_allclose(np.linalg.norm(fine.normals, axis=1), 1)


def _ball():
    ball = trimesh.creation.icosphere(1, 1.0)
    return ball.vertices, ball.faces


@pytest.mark.parametrize("size_m", [0.0, -1.0, float("nan"), 1e-9])
def test_a_size_that_is_none_is_refused(size_m):
    with pytest.raises(ValueError, match="sides"):
        subdivide(box(), size_m)


def test_a_flat_box_has_one_radiance_for_each_corner_of_each_side():
    surface = lit_surface(box(), smooth=False)
    assert len(surface.points) == 24
    np.testing.assert_allclose(np.abs(surface.normals).max(axis=1), 1)
    corners, entries = surface.vertices[surface.faces], surface.points[surface.shades]
    np.testing.assert_allclose(corners, entries, atol=5e-3)
    planes = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for k in range(3):  # in the plane of the facet, and inside the side
        assert np.abs(((entries[:, k] - corners[:, k]) * planes).sum(axis=1)).max() < 1e-12
        assert (np.abs(entries[:, k]) <= np.abs(corners[:, k]) + 1e-12).all()
    assert len(lit_surface(subdivide(box(), 0.3), smooth=False).points) < 1.3 * len(subdivide(box(), 0.3).vertices)


def test_no_facet_faces_an_eye_that_is_below_the_lean_of_a_corner():
    mesh = build_mesh(*_ball())
    surface = lit_surface(mesh, smooth=True)
    eyes = np.random.default_rng(0).normal(size=(500, 3)) * 3
    facets = np.cross(*(mesh.vertices[mesh.faces[:, k]] - mesh.vertices[mesh.faces[:, 0]] for k in (1, 2)))
    for eye in eyes:
        facing = ((eye - mesh.vertices[mesh.faces[:, 0]]) * facets).sum(axis=1) > 0
        towards = eye - surface.points
        sine = (towards * surface.normals).sum(axis=1) / np.linalg.norm(towards, axis=1)
        assert (sine > -surface.lean - 1e-3)[mesh.faces[facing]].all()
