"""Facets brighter or darker than their body's law: from the file to the light."""

import dataclasses

import numpy as np
import pytest

from emulator.geometry.camera import Pinhole
from emulator.photometry.reflectance import Lambert
from emulator.scene.bodies.lit_surface import lit_surface, subdivide
from emulator.scene.bodies.mesh import build_mesh, find_shape, load_mesh
from emulator.scene.bodies.mesh_files import PlateTableError, parse_wavefront
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.regolith import coarser
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.tables.typed_table import RigFile
from emulator.trajectory.parameters import FixedPath
from laboratory.accuracy.sampled_scenes import SampledBodies

# A box of 2 m with its front, at z = -1, in two halves along x; the right one is a quarter as bright.
BOX = """
v -1 -1 -1\nv 0 -1 -1\nv 1 -1 -1\nv -1 1 -1\nv 0 1 -1\nv 1 1 -1
v -1 -1 1\nv 1 -1 1\nv -1 1 1\nv 1 1 1
f 1 4 5 2
usemtl albedo_0.25
f 2 5 6 3
usemtl other
f 7 8 10 9
f 1 2 3 8 7
f 4 9 10 6 5
f 1 7 9 4
f 3 6 10 8
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "box.obj"
    path.write_text(BOX)
    body = BodyTable(shape=RigFile(str(path)), reflectance=Lambert(albedo=0.5), smooth=False)
    camera = FixedPath(position_m=(0.0, 0.0, -10.0))
    sun = dataclasses.replace(BodiesParameters(bodies=(body,)).sun, direction=(0.0, 0.0, -1.0))
    return BodiesParameters(camera=camera, sun=sun, bodies=(body,))


PINHOLE = Pinhole(64, 48, 20.0)


def picture(scene):
    light = np.zeros((48, 64), np.float32)
    scene.light(0, light)
    scene.close()
    return light


def test_the_light_of_facets_follows_their_albedo_in_the_renderer_and_in_the_reference(scene):
    for build in (RasterBodies, lambda p, h: SampledBodies(p, h, 4)):
        light = picture(build(scene, PINHOLE))
        left, right = light[20:28, 22:30], light[20:28, 34:42]
        np.testing.assert_allclose(right.mean() / left.mean(), 0.25, rtol=1e-4)


def test_albedo_survives_dividing_and_gathering():
    table = parse_wavefront(BOX)
    mesh = build_mesh(table.vertices, table.facets, table.albedo)

    def mean(m):
        a, b, c = (m.vertices[m.faces[:, k]] for k in range(3))
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        return (areas * m.albedo.mean(axis=1)).sum() / areas.sum()

    assert mean(mesh) == pytest.approx(1 - 0.75 * 2 / 24)
    for other in (subdivide(mesh, 0.3), subdivide(mesh, 0.5)):
        assert mean(other) == pytest.approx(mean(mesh))
    assert set(np.unique(lit_surface(mesh, smooth=False).albedo)) == {0.25, 1.0}
    globe = load_mesh(find_shape("globe"), 1.0)
    shaded = dataclasses.replace(globe, albedo=(1.5 + globe.vertices[:, 2])[globe.faces])
    assert mean(coarser(shaded, 0.5)) == pytest.approx(1.5, rel=0.02)


def test_materials_that_name_no_albedo_are_ignored_and_bad_ones_refused():
    assert parse_wavefront(BOX.replace("albedo_0.25", "gold")).albedo is None
    for bad in ("albedo_-1", "albedo_nan", "albedo_x", "albedo_1e9"):
        with pytest.raises(PlateTableError, match="albedo_A"):
            parse_wavefront(BOX.replace("albedo_0.25", bad))
