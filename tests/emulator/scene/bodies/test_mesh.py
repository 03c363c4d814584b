from __future__ import annotations

import sys

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from emulator.light import SceneError
from emulator.scene.bodies.mesh import build_mesh, find_shape, load_mesh, read_surface
from emulator.scene.bodies.mesh_files import PlateTableError, parse_plates, parse_wavefront
from tests.emulator.scene.bodies.volume import volume_m3

# a tetrahedron, counter-clockwise from outside, volume 1/6
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def tagged(points=POINTS, faces=FACES, base=0):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(points, float).tolist()]
    return "\n".join(lines + [f"f {i + base} {j + base} {k + base}" for i, j, k in np.asarray(faces).tolist()])


def counted(*, numbered, one_line, points=POINTS, faces=FACES):
    def rows(array):
        return [f"{n if numbered else ''} {' '.join(map(str, row))}" for n, row in enumerate(array.tolist(), 1)]

    head = [f" {len(points)} {len(faces)}"] if one_line else [f" {len(points)}"]
    middle = [] if one_line else [f" {len(faces)}"]
    return "\n".join(head + rows(points) + middle + rows(faces + 1))


def write(tmp_path, text, name="shape.tab"):
    path = tmp_path / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("name", "facets", "vertices", "volume_km3", "area_km2", "extents_km"),
    [
        ("eros022540", 22_540, 11_272, 2532.6, 1122.9, (32.73, 16.87, 11.98)),
        ("eros007790", 7_790, 3_897, 2526.0, 1118.4, (32.69, 16.82, 11.95)),
    ],
)
def test_eros_measures_what_its_sources_say(name, facets, vertices, volume_km3, area_km2, extents_km):
    eros = load_mesh(find_shape(name))
    assert (len(eros.faces), len(eros.vertices)) == (facets, vertices)
    assert volume_m3(eros) / 1e9 == pytest.approx(volume_km3, abs=0.05)
    assert eros.area_m2 / 1e6 == pytest.approx(area_km2, abs=0.05)
    np.testing.assert_allclose(np.ptp(eros.vertices, axis=0) / 1e3, extents_km, atol=0.006)
    assert eros.warnings == ()
    np.testing.assert_allclose(np.linalg.norm(eros.normals, axis=1), 1, rtol=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        tagged(),
        tagged(base=1),
        "# a comment\n\n" + tagged(base=1).replace("\n", "\n\n"),
        tagged().replace("1.0", "1.0D+00"),
        counted(numbered=True, one_line=False),
        counted(numbered=False, one_line=False),
        counted(numbered=True, one_line=True),
        counted(numbered=False, one_line=True),
    ],
)
def test_every_family_of_plate_table_gives_the_same_shape(text):
    table = parse_plates(text)
    np.testing.assert_array_equal(table.vertices, POINTS)
    np.testing.assert_array_equal(table.facets, FACES)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no line"),
        ("v 1 2", "line 1: 'v 1 2' is not 'v x y z'"),
        ("v 1 2 3\nw 1 2 3", "line 2"),
        ("v 1 2 x", "line 1: '1 2 x' is not three numbers"),
        ("v 1 2 3\nf 0 1 -2", "line 2: '0 1 -2' is not three vertex numbers"),
        ("v 1 2 3\nf 0 1 1.5", "line 2"),
        ("v 1 2 3\nf 0 1 99999999999999999999", "line 2"),
        ("hello", "line 1: 'hello' is not a count"),
        ("3\n0 0 0\n1 0 0\n0 1 0", "ends before the facets"),
        ("3\n0 0 0\n1 0 0\n0 1 0\n2\n1 2 3", "3 vertices and 2 facets are announced, 3 and 1 are there"),
        ("1 1\n0 0\n1 2 3", "line 2"),
    ],
)
def test_a_broken_plate_table_names_its_line(text, says):
    with pytest.raises(PlateTableError) as caught:
        parse_plates(text)
    assert says in str(caught.value)


@given(st.text(alphabet="vf#0123456789.-+eEDn \n\x00é", max_size=200))
def test_any_text_is_a_table_or_refused(text):
    try:
        table = parse_plates(text)
    except PlateTableError:
        return
    assert table.vertices.shape[1:] == table.facets.shape[1:] == (3,)


@given(st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 3), min_size=4, max_size=9), st.sampled_from([0, 1]))
def test_tables_round_trip(points, base):
    table = parse_plates(tagged(points, FACES, base))
    np.testing.assert_array_equal(table.vertices, points)
    np.testing.assert_array_equal(table.facets, FACES)


def test_units_scale_the_shape(tmp_path):
    path = write(tmp_path, tagged())
    assert volume_m3(load_mesh(path)) == pytest.approx(1e9 / 6)
    assert volume_m3(load_mesh(path, units_m=1.0)) == pytest.approx(1 / 6)
    assert load_mesh(path, units_m=2.0).area_m2 == pytest.approx(4 * (1.5 + np.sqrt(3) / 2))


def test_an_obj_with_split_vertices_is_welded_and_its_texture_ignored(tmp_path):
    lines, corner = ["mtllib nowhere.mtl", "usemtl paint"], 0
    for face in FACES:
        lines += [f"v {' '.join(map(str, POINTS[i]))}" for i in face]
        lines += [f"vt {i / 3} {corner / 12}" for i in range(3)]
        lines += [f"f {' '.join(f'{corner + i}/{corner + i}' for i in (1, 2, 3))}"]
        corner += 3
    solid = load_mesh(write(tmp_path, "\n".join(lines), "solid.obj"), units_m=1.0)
    assert (len(solid.vertices), len(solid.faces), solid.open_edges) == (4, 4, 0)
    assert volume_m3(solid) == pytest.approx(1 / 6)


def test_an_inside_out_mesh_is_turned():
    solid = build_mesh(POINTS, FACES[:, ::-1])
    assert solid.was_inside_out
    assert volume_m3(solid) == pytest.approx(1 / 6)
    assert "inside out" in solid.warnings[0]


def test_facets_without_area_are_dropped_and_counted():
    points = np.vstack([POINTS, [2, 0, 0], POINTS[1]])
    flat = [[0, 1, 1], [0, 1, 4], [1, 5, 2]]  # a corner twice, three in a row, two at the same place
    solid = build_mesh(points, np.vstack([FACES, flat]))
    assert (solid.dropped_facets, solid.open_edges) == (3, 0)
    assert len(solid.vertices) == 4
    assert np.isfinite(solid.normals).all()


def test_holes_are_counted_and_kept():
    shell = build_mesh(POINTS, FACES[:3])
    assert shell.open_edges == 3
    assert "dark sky" in shell.warnings[0]


@pytest.mark.parametrize(
    ("points", "faces", "says"),
    [
        (POINTS, np.empty((0, 3)), "nothing to draw"),
        (np.empty((0, 3)), FACES, "nothing to draw"),
        (np.where(POINTS == 1, np.nan, POINTS), FACES, "not finite"),
        (POINTS * 1e300, FACES, "not finite or beyond"),
        (POINTS, FACES + 1, "facet 1 (counted from 0) has [1, 2, 4], and there are 4 vertices"),
        (POINTS, FACES - 1, "name a vertex that is not there"),
        (POINTS, [[0, 1, 1]], "no facet has any area"),
        (POINTS, [*FACES[:3].tolist(), FACES[3, ::-1].tolist()], "disagree on which side is outside (3 edges"),
    ],
)
def test_what_cannot_be_drawn_is_refused(points, faces, says):
    with pytest.raises(SceneError) as caught:
        build_mesh(points, faces)
    assert says in str(caught.value)


def test_a_shape_that_is_not_there_names_the_shipped_ones():
    with pytest.raises(SceneError, match="eros007790, eros022540"):
        find_shape("erso")


def exported(kind, encoding=None):
    """Return the octets of a shape of 80 facets and 42 vertices."""
    ball = trimesh.creation.icosphere(1)
    text = ball.export(file_type=kind, **({"encoding": encoding} if encoding else {}))
    return text if isinstance(text, bytes) else text.encode()


@pytest.mark.parametrize(
    ("kind", "content", "says"),
    [
        ("stl", exported("stl")[:-30], "is cut: 80 facets are announced, and 30 of their octets are missing"),
        ("stl", exported("stl")[:83], "octets are missing"),
        ("stl", exported("stl") + b"more", "4 octets follow the 80 facets"),
        ("stl", b"solid" + exported("stl")[5:-1], "1 of their octets are missing"),
        ("stl", exported("stl_ascii")[:-200], "is cut after 79 facets"),
        ("ply", exported("ply", "ascii")[:-40], "122 vertices and facets are announced"),
        ("ply", exported("ply", "binary")[:-40], "unexpected length"),
        ("off", exported("off")[:-40], "122 vertices and facets are announced"),
        ("off", exported("off").replace(b"OFF\n", b"OFF\n# 3 4 5\n")[:-40], "122 vertices and facets are announced"),
        ("ply", trimesh.PointCloud(POINTS).export(file_type="ply"), "no facet, nothing to draw: a cloud of points"),
        ("off", bytes(range(128, 256)), "not UTF-8|cannot read"),
    ],
)
def test_a_cut_surface_names_what_is_missing(tmp_path, monkeypatch, kind, content, says):
    """Each is read in this process, and without the library that guesses the encoding of a text."""
    monkeypatch.setitem(sys.modules, "charset_normalizer", None)
    monkeypatch.setattr("emulator.scene.bodies.mesh.read_in_child", lambda reader, path: read_surface(path))
    (tmp_path / f"shape.{kind}").write_bytes(content)
    with pytest.raises(SceneError, match=says):
        load_mesh(tmp_path / f"shape.{kind}")


@pytest.mark.parametrize(("kind", "encoding"), [("stl", None), ("stl_ascii", None), ("ply", "ascii"), ("off", None)])
def test_an_intact_surface_is_read(tmp_path, kind, encoding):
    (tmp_path / f"shape.{kind[:3]}").write_bytes(exported(kind, encoding))
    assert len(read_surface(tmp_path / f"shape.{kind[:3]}")["faces"]) == 80


@pytest.mark.parametrize("facet", ["0 1 2", "1 2 -4", "-0 1 2"])
def test_a_vertex_0_of_an_obj_file_is_refused_with_its_line(facet):
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    assert parse_wavefront(f"{corners}f 1/1 2 -1").facets.tolist() == [[0, 1, 2]]
    with pytest.raises(PlateTableError, match=f"line 4: 'f {facet}' is not a facet of vertices that count from 1"):
        parse_wavefront(f"{corners}f {facet}")


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("name", ["broken.obj", "broken.stl", "broken.ply", "broken.xyzzy", "noextension"])
@pytest.mark.parametrize("content", ["", "v 1 2\nf 9 9 9\n", "\x00\x01ply\nformat"])
def test_broken_files_of_other_formats_are_refused(tmp_path, name, content):
    with pytest.raises(SceneError, match=name):
        load_mesh(write(tmp_path, content, name))


def test_a_large_shape_model_is_parsed_once(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first = load_mesh(find_shape("eros007790"))

    def fail(_):
        raise PlateTableError("parsed again")

    monkeypatch.setattr("emulator.scene.bodies.mesh.parse_plates", fail)
    again = load_mesh(find_shape("eros007790"))
    assert np.array_equal(again.vertices, first.vertices)
    assert np.array_equal(again.faces, first.faces)
    other = tmp_path / "other.tab"
    other.write_text(find_shape("eros007790").read_text() + "\n")
    with pytest.raises(SceneError, match="parsed again"):
        load_mesh(other)
