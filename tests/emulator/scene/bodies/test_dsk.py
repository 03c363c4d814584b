"""Shapes from digital shape kernels of SPICE, written here by spiceypy."""

import numpy as np
import pytest
import trimesh

from emulator.light import SceneError
from emulator.scene.bodies.mesh import load_mesh
from tests.emulator.scene.bodies.volume import volume_m3

spiceypy = pytest.importorskip("spiceypy", reason="the extra `spice` is not installed")

pytestmark = pytest.mark.system

RADII_KM = np.array([2.0, 1.0, 0.5])


def solid(at_km=(0.0, 0.0, 0.0)):
    """Return vertices (n, 3) in km and facets (m, 3) from 0 of an ellipsoid."""
    ball = trimesh.creation.icosphere(2)
    return ball.vertices * RADII_KM + at_km, ball.faces


def write(path, *segments, frames=("IAU_EROS",) * 9):
    """Write a shape kernel of Eros with a segment for each pair of vertices and facets."""
    handle = spiceypy.dskopn(str(path), "test", 0)
    for number, ((vertices, facets), frame) in enumerate(zip(segments, frames, strict=False), 1):
        plates, spread = (facets + 1).astype(np.int32), np.zeros(10)
        index = spiceypy.dskmi2(vertices, plates, 1.2, 4, 200_000, 20_000, 40_000, False, 200_000)
        low, high = spiceypy.dskrb2(vertices, plates, 1, spread)
        limits = (-np.pi, np.pi, -np.pi / 2, np.pi / 2, low, high, 0.0, 1e9)
        spiceypy.dskw02(handle, 2_000_433, number, 1, frame, 1, spread, *limits, vertices, plates, *index)
    spiceypy.dskcls(handle, True)
    return path


def test_all_segments_are_read_with_their_vertices_and_facets(tmp_path):
    first, second = solid(), solid(at_km=(10.0, 0.0, 0.0))
    mesh = load_mesh(write(tmp_path / "two.bds", first, second))
    expected = trimesh.util.concatenate([trimesh.Trimesh(*one, process=False) for one in (first, second)])
    assert volume_m3(mesh) == pytest.approx(expected.volume * 1e9, rel=1e-12)
    assert mesh.area_m2 == pytest.approx(expected.area * 1e6, rel=1e-12)
    assert (mesh.open_edges, mesh.dropped_facets) == (0, 0)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), 1e3 * expected.vertices.max(axis=0), rtol=1e-15)


def test_a_kernel_that_cannot_be_a_shape_is_refused(tmp_path):
    one = write(tmp_path / "frames.bds", solid(), solid((9.0, 0.0, 0.0)), frames=("IAU_EROS", "J2000"))
    with pytest.raises(SceneError, match=r"frames\.bds.*segments are in 2 frames"):
        load_mesh(one)
    sound = write(tmp_path / "sound.bds", solid()).read_bytes()
    for name, content in {"empty.bds": b"", "text.dsk": b"KPL/FK\n", "cut.bds": sound[: len(sound) // 3]}.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(SceneError, match=name):
            load_mesh(tmp_path / name)


@pytest.mark.parametrize("seed", range(4))
def test_damaged_kernels_give_a_mesh_or_an_error(tmp_path, seed):
    """CSPICE is C: what it does with damaged bytes stays in the child process."""
    draw, path = np.random.default_rng(seed), write(tmp_path / "damaged.bds", solid())
    data = bytearray(path.read_bytes())
    for place in draw.integers(0, len(data), 200):
        data[place] = draw.integers(0, 256)
    path.write_bytes(data)
    try:
        outcome = str(np.isfinite(load_mesh(path).vertices).all())
    except SceneError as error:
        outcome = str(error)
    assert outcome == "True" or "damaged.bds" in outcome
