"""Bodies of glTF files: trimesh reads the same shapes, closed forms give their motion, bad files are refused."""

import base64
import json
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from emulator.geometry.camera import Pinhole
from emulator.light import SceneError
from emulator.photometry.reflectance import Glossy, Lambert, Sun
from emulator.scene.bodies.gltf import _MOST, ModelContents, read_gltf
from emulator.scene.bodies.models import law_of, load_bodies
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.scene.bodies.usd import read_usd
from emulator.trajectory.building import build_trajectories
from emulator.trajectory.parameters import FixedPath, SpinPath
from tests.emulator.scene.bodies.test_textures import sheet, smooth_image

pytestmark = pytest.mark.usefixtures("reads_here")

S = 1_000_000_000
TURN_S = 4.0
PLACE = (0.5, 2.0, -0.25)
TILT = Rotation.from_euler("XYZ", [0.4, -0.2, 0.7])
BUS, PANEL = trimesh.creation.box((1.0, 1.0, 1.0)), trimesh.creation.box((0.2, 2.0, 1.0))


def document(turns=None, panel=None, interpolation="LINEAR", path="rotation"):
    """Return the JSON and the octets of a bus that is tilted and stretched, and its panel, which moves."""
    data, views, accessors = b"", [], []

    def add(array, kind):
        nonlocal data
        array = np.ascontiguousarray(array, "<u4" if np.asarray(array).dtype.kind == "i" else "<f4")
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        component = 5125 if array.dtype == np.dtype("<u4") else 5126
        accessors.append({"bufferView": len(views) - 1, "componentType": component, "count": len(array), "type": kind})
        data += array.tobytes()
        return len(accessors) - 1

    def mesh(shape):
        at = add(shape.vertices, "VEC3"), add(np.asarray(shape.faces, np.int64).ravel(), "SCALAR")
        return {"primitives": [{"attributes": {"POSITION": at[0]}, "indices": at[1]}]}

    made = {"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "meshes": [mesh(BUS), mesh(PANEL)]}
    arm = {"name": "arm", "rotation": TILT.as_quat().tolist(), "scale": [2.0, 2.0, 2.0], "children": [1, 2]}
    bus = {"name": "bus", "mesh": 0, "translation": [0.0, -1.0, 0.0], "scale": [1.0, 0.5, 2.0]}
    made["nodes"] = [arm, bus, {"name": "panel", "mesh": 1, "translation": list(PLACE), **(panel or {})}]
    if turns is not None:
        times = add(np.linspace(0.0, TURN_S, len(turns) // (3 if interpolation == "CUBICSPLINE" else 1)), "SCALAR")
        values = add(turns, "VEC3" if path == "translation" else "VEC4")
        made["animations"] = [
            {
                "name": "turn",
                "samplers": [{"input": times, "output": values, "interpolation": interpolation}],
                "channels": [{"sampler": 0, "target": {"node": 2, "path": path}}],
            }
        ]
    made |= {"bufferViews": views, "accessors": accessors, "buffers": [{"byteLength": len(data)}]}
    return made, data


def glb(made, data):
    text = json.dumps(made).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def about_y(angles):
    return Rotation.from_rotvec(np.outer(angles, [0.0, 1.0, 0.0]))


TURNS = about_y(np.linspace(0, 2 * np.pi, 5)).as_quat()


def write(tmp_path, made, data, name="model.glb"):
    path = tmp_path / name
    path.write_bytes(glb(made, data))
    return path


def loaded(path, **more):
    found = load_bodies(BodiesParameters(bodies=(BodyTable(name="craft", shape=str(path), **more),)))
    return found.parameters.bodies, found.meshes, build_trajectories([table.path for table in found.parameters.bodies])


def corners(mesh, pose=None):
    """Return the corners of all facets in the model's frame, in the file's order."""
    points = mesh.vertices if pose is None else mesh.vertices @ pose.world_from_body.T + pose.position_m
    return points[np.asarray(mesh.faces)]


@pytest.mark.parametrize("t_s", [0.0, 0.3, 1.0, 2.7, 9.0])
def test_a_model_of_two_nodes_moves_as_it_says(tmp_path, t_s):
    """trimesh reads the file with the panel turned by the closed form, and still."""
    tables, meshes, paths = loaded(write(tmp_path, *document(TURNS)))
    angle = 2 * np.pi * min(t_s, TURN_S) / TURN_S
    still = document(panel={"rotation": about_y([angle]).as_quat()[0].tolist()})
    expected = trimesh.load_scene(write(tmp_path, *still, name="still.glb"))
    by_node = {node: expected.geometry[expected.graph[node][1]].copy() for node in expected.graph.nodes_geometry}
    for node, mesh in by_node.items():
        mesh.apply_transform(expected.graph[node][0])
    assert [(table.name, table.fixed_to) for table in tables] == [("craft", ""), ("craft/panel", "craft")]
    np.testing.assert_allclose(corners(meshes[0]), corners(by_node["bus"]), atol=2e-5)
    np.testing.assert_allclose(corners(meshes[1], paths[1].pose(round(t_s * S))), corners(by_node["panel"]), atol=2e-5)
    assert not tables[0].smooth


def test_cubic_tracks_are_hermite_curves_through_their_tangents(tmp_path):
    def place(t):
        return np.array([t**3 - t, 0.5 * t**2, 2 - t])

    def slope(t):
        return np.array([3 * t**2 - 1, t, -1.0])

    keys = [row for t in (0.0, 2.0, 4.0) for row in (slope(t), place(t), slope(t))]
    _, _, paths = loaded(write(tmp_path, *document(np.array(keys), None, "CUBICSPLINE", "translation")), units_m=3.0)
    for t in (0.4, 1.9, 3.3):
        np.testing.assert_allclose(paths[1].pose(round(t * S)).position_m, 6 * TILT.apply(place(t)), rtol=1e-5)
        velocity = paths[1].motion(round(t * S)).velocity_m_s
        np.testing.assert_allclose(velocity, 6 * TILT.apply(slope(t)), rtol=1e-4)
        assert np.linalg.norm(velocity) <= paths[1].bounds.speed_m_s


def test_an_animation_that_closes_can_repeat(tmp_path):
    _, _, paths = loaded(write(tmp_path, *document(TURNS)), repeat=True)
    ahead = paths[1].pose(9 * S)
    np.testing.assert_allclose(ahead.world_from_body, (TILT * about_y([np.pi / 2])[0]).as_matrix(), atol=1e-6)
    with pytest.raises(SceneError, match="ends elsewhere"):
        loaded(write(tmp_path, *document(TURNS[:3])), repeat=True)


@pytest.mark.long
def test_the_light_and_its_rate_are_those_of_the_same_bodies_on_a_spin(tmp_path):
    """The rate of spinning bodies is checked with point samples in test_raster_bodies."""
    law, camera = Lambert(0.5), Pinhole.of_field((48, 36), 40.0)
    model = BodyTable(shape=str(write(tmp_path, *document(TURNS))), reflectance=law, path=FixedPath((0.0, 0.0, 20.0)))
    bus, panel = BUS.copy(), PANEL.copy()
    bus.apply_scale((1.0, 0.5, 2.0))
    bus.apply_translation((0.0, -1.0, 0.0))
    bus.apply_scale(2.0)
    bus.apply_transform(np.block([[TILT.as_matrix(), np.zeros((3, 1))], [np.zeros((1, 3)), 1.0]]))
    panel.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))  # its y is the pole, z
    place = TILT.apply(2 * np.array(PLACE))
    spin = SpinPath(tuple(place), tuple(TILT.apply([0, 1, 0])), spin_deg_s=360 / TURN_S)
    start = build_trajectories([spin])[0].pose(0).world_from_body
    panel.vertices = 2 * PANEL.vertices @ TILT.as_matrix().T @ start  # at time 0 as the file's
    bus.export(tmp_path / "bus.stl")
    panel.export(tmp_path / "panel.stl")
    parts = (
        BodyTable("bus", str(tmp_path / "bus.stl"), reflectance=law, path=model.path, smooth=False),
        BodyTable("", str(tmp_path / "panel.stl"), path=spin, fixed_to="bus", reflectance=law, smooth=False),
    )
    for t_s in (0.3, 1.7):
        found, expected = (_light(bodies, camera, t_s) for bodies in ((model,), parts))
        assert expected[0].any()
        assert expected[1].any()
        np.testing.assert_allclose(found[0], expected[0], atol=1e-4 * expected[0].max())
        np.testing.assert_allclose(found[1], expected[1], atol=1e-3 * np.abs(expected[1]).max())


def _light(bodies, camera, t_s):
    light, rate = np.zeros((2, *camera.size[::-1]), np.float32)
    with RasterBodies(BodiesParameters(bodies=bodies, sun=Sun((0.6, -0.3, -0.7))), camera) as drawn:
        drawn.light_and_rate(round(t_s * S), light, rate)
    return light, rate


def test_materials_become_laws():
    law = law_of({"luminance": 0.5, "metallic": 0.25, "roughness": 0.5})
    assert law == Glossy(0.375, 0.04 * 0.75 + 0.125, 30.0)
    assert law_of({"luminance": 1.0, "metallic": 1.0, "roughness": 1.0}) == Glossy(0.0, 1.0, 1.0)
    assert law_of({"luminance": 1.0, "metallic": 0.0, "roughness": 0.0}).sharpness == 1e5


def test_the_rig_s_reflectance_replaces_materials(tmp_path):
    made, data = document()
    made["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1], "metallicFactor": 0}}]
    made["meshes"][0]["primitives"][0]["material"] = 0
    path = write(tmp_path, made, data)
    assert loaded(path)[0][0].reflectance.albedo == pytest.approx(0.2126)
    assert loaded(path, reflectance=Lambert(0.3))[0][0].reflectance == Lambert(0.3)


def changed(change):
    made, data = document(TURNS)
    change(made)
    return glb(made, data)


BAD = {
    "cut": (lambda: glb(*document(TURNS))[:200], "cut off"),
    "chunk": (lambda: glb(*document(TURNS))[:12] + b"\xff\xff\xff\x7fJSON", "cut off"),
    "chunk length": (lambda: glb(*document())[:12] + b"\xff\xff\xff\x7f" + glb(*document())[16:], "chunk at byte 12"),
    "version": (lambda: changed(lambda d: d["asset"].update(version="1.0")), "version '1.0'"),
    "count": (lambda: changed(lambda d: d["accessors"][0].update(count=10**9)), "1000000000 items do not fit"),
    "view": (lambda: changed(lambda d: d["bufferViews"][0].update(byteOffset=10**9)), "ends at byte"),
    "index": (lambda: changed(lambda d: d["accessors"][0].update(count=3)), "an index is 7, and there are 3"),
    "circle": (lambda: changed(lambda d: d["nodes"][1].update(children=[0])), "own ancestor"),
    "parents": (lambda: changed(lambda d: d["nodes"][1].update(children=[2])), "two parents"),
    "outside": (lambda: changed(lambda d: d["buffers"][0].update(uri="../../etc/passwd")), "own folder"),
    "address": (lambda: changed(lambda d: d["buffers"][0].update(uri="http://a/b")), "own folder"),
    "missing": (lambda: changed(lambda d: d["buffers"][0].update(uri="no.bin")), "missing"),
    "text": (lambda: changed(lambda d: d["buffers"][0].update(uri="data:x;base64,%%")), "no base64"),
    "step": (lambda: changed(lambda d: d["animations"][0]["samplers"][0].update(interpolation="STEP")), "jumps"),
    "scale": (lambda: changed(lambda d: d["animations"][0]["channels"][0]["target"].update(path="scale")), "rigid"),
    "uneven": (lambda: changed(lambda d: d["nodes"][0].update(scale=[1, 2, 1])), "uneven"),
    "draco": (lambda: changed(lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"])), "draco"),
    "nodes": (lambda: changed(lambda d: d["nodes"].extend([{}] * 10_000)), "10000 nodes"),
    "channels": (lambda: changed(lambda d: d["animations"][0]["channels"].extend([{}] * 1024)), "1024 animated"),
    "empty": (lambda: changed(lambda d: [node.pop("mesh", None) for node in d["nodes"]]), "no node"),
    "deep": (lambda: b"[" * 200_000, "cannot be read"),
}


@pytest.mark.parametrize("name", sorted(BAD.keys() - {"uneven", "empty"}))
def test_bad_files_are_refused(tmp_path, name):
    make, says = BAD[name]
    (tmp_path / "bad.glb").write_bytes(make())
    with pytest.raises(SceneError, match=says):
        read_gltf(tmp_path / "bad.glb")


def test_a_model_bomb_is_refused_before_its_parts_are_made(tmp_path, monkeypatch):
    """9999 nodes with the same 100 primitives in a small file: the reader names the limit, and sends nothing."""
    made, data = document()
    made["meshes"][0]["primitives"] *= 100
    made["nodes"], made["scenes"] = [{"mesh": 0}] * 9999, [{"nodes": list(range(9999))}]
    added = []
    monkeypatch.setattr(ModelContents, "_values", lambda *_: added.append("values"))
    with pytest.raises(SceneError, match="has more than 256 parts: join"):
        read_gltf(write(tmp_path, made, data))
    made["nodes"], made["scenes"] = [{"mesh": 0}] * 200, [{"nodes": list(range(200))}]
    made["meshes"][0]["primitives"] = made["meshes"][0]["primitives"][:1]
    monkeypatch.setitem(_MOST, "facets", 100 * len(BUS.faces))
    with pytest.raises(SceneError, match="has more than 1200 facets"):
        read_gltf(write(tmp_path, made, data))
    assert not added


def test_vertices_that_are_not_finite_are_refused(tmp_path):
    made, data = document()
    with pytest.raises(SceneError, match="not finite"):
        read_gltf(write(tmp_path, made, struct.pack("<f", np.nan) + data[4:]))


def test_octets_may_be_text_or_beside_the_file(tmp_path):
    made, data = document(TURNS)
    expected = read_gltf(write(tmp_path, made, data))
    (tmp_path / "beside.bin").write_bytes(data)
    for uri in ("beside.bin", "data:application/octet-stream;base64," + base64.b64encode(data).decode()):
        made["buffers"][0]["uri"] = uri
        (tmp_path / "model.gltf").write_text(json.dumps(made))
        found = read_gltf(tmp_path / "model.gltf")
        assert all((found[key] == expected[key]).all() for key in expected)


WHOLE = (glb(*document(TURNS)), sheet(smooth_image(8, 8)).export(file_type="glb"))
MOST = max(map(len, WHOLE))
VALUES = st.one_of(st.none(), st.integers(-3, 2**70), st.floats(), st.text(max_size=3), st.just([]), st.just({}))


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from(WHOLE), st.lists(st.tuples(st.integers(0, MOST), st.integers(0, 255)), max_size=6),
    st.integers(20, MOST),
)  # fmt: skip
def test_damaged_octets_are_read_or_refused(tmp_path_factory, whole, damage, length):
    data = bytearray(whole)
    for at, octet in damage:
        data[at % len(data)] = octet
    _read_or_refuse(tmp_path_factory, bytes(data[:length]))


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damaged_json_is_read_or_refused(tmp_path_factory, data):
    made, octets = document(TURNS)
    place = made
    while isinstance(place, (dict, list)) and place:
        key = data.draw(st.sampled_from(sorted(place) if isinstance(place, dict) else range(len(place))))
        if not isinstance(place[key], (dict, list)) or data.draw(st.integers(0, 3)) == 0:
            place[key] = data.draw(VALUES)
            break
        place = place[key]
    _read_or_refuse(tmp_path_factory, glb(made, octets))


def _read_or_refuse(tmp_path_factory, octets):
    path = tmp_path_factory.getbasetemp() / "damaged.glb"
    path.write_bytes(octets)
    try:
        found = read_gltf(path)
    except SceneError:
        return
    header = json.loads(found["header"].tobytes())
    for part in header["parts"]:
        assert np.isfinite(found[part["vertices"]]).all()
        assert found[part["faces"]].max(initial=-1) < len(found[part["vertices"]])
        if part["texture"]:
            assert np.isfinite(found[part["texture"]["uv"]]).all()
            assert (found[part["texture"]["luminance"]] >= 0).all()
            assert len(found[part["texture"]["uv"]]) == len(found[part["vertices"]])


USD = """#usda 1.0
(
    metersPerUnit = 0.01
    startTimeCode = 24
    endTimeCode = 72
    timeCodesPerSecond = 24
    upAxis = "Z"
)
def Xform "craft" {
    double3 xformOp:translate = (100, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Mesh "bus" {
        int[] faceVertexCounts = [3, 3, 3, 3]
        int[] faceVertexIndices = [0, 2, 1, 0, 1, 3, 1, 2, 3, 0, 3, 2]
        point3f[] points = [(0, 0, 0), (100, 0, 0), (0, 100, 0), (0, 0, 100)]
    }
    def Mesh "panel" {
        double3 xformOp:translate.timeSamples = { 24: (0, 0, 0), 72: (0, 200, 0) }
        float3 xformOp:rotateXYZ.timeSamples = { 24: (0, 0, 0), 72: (90, 0, 360) }
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        point3f[] points = [(0, 0, 0), (100, 0, 0), (100, 50, 0), (0, 50, 0)]
    }
}
"""


def test_a_usd_stage_moves_as_its_samples_say(tmp_path):
    pytest.importorskip("pxr", reason="usd-core")
    (tmp_path / "stage.usda").write_text(USD)
    tables, meshes, paths = loaded(tmp_path / "stage.usda")
    assert [table.name for table in tables] == ["craft", "craft/panel"]
    np.testing.assert_allclose(meshes[0].vertices.max(axis=0), [2, 1, 1])
    assert len(meshes[1].faces) == 2
    for t_s in (0.0, 0.37, 1.0, 1.9):
        pose = paths[1].pose(round(t_s * S))
        turn = Rotation.from_euler("xyz", [45 * t_s, 0, 180 * t_s], degrees=True)
        np.testing.assert_allclose(pose.position_m, [1, t_s, 0], atol=1e-6)
        np.testing.assert_allclose(pose.world_from_body, turn.as_matrix(), atol=3e-5)


def test_a_bad_usd_stage_is_refused(tmp_path):
    pytest.importorskip("pxr", reason="usd-core")
    (tmp_path / "bad.usda").write_text("#usda 1.0\ndef Mesh {")
    (tmp_path / "counts.usda").write_text(USD.replace("[3, 3, 3, 3]", "[3, 3, 3, 1000000000]"))
    for name, says in (("bad.usda", "cannot be read"), ("counts.usda", "do not fit")):
        with pytest.raises(SceneError, match=says):
            loaded(tmp_path / name)


LAYERS = {
    "sublayer": "( subLayers = [@%s@] )",
    "reference": 'def "a" ( references = @%s@ ) {}',
    "payload": 'def "a" ( payload = @%s@ ) {}',
    "clip": """
        def "a" (
            clips = {
                dictionary default = {
                    asset[] assetPaths = [@%s@]
                    asset manifestAssetPath = @%s@
                    string primPath = "/craft"
                    double2[] active = [(0, 0)]
                    double2[] times = [(0, 0), (9, 9)]
                }
            }
        ) {
            def Xform "panel" {
                double3 xformOp:translate
                uniform token[] xformOpOrder = ["xformOp:translate"]
            }
        }
    """,
}


@pytest.mark.parametrize("kind", sorted(LAYERS))
def test_layers_outside_the_folder_of_a_stage_are_refused(tmp_path, kind):
    pytest.importorskip("pxr", reason="usd-core")
    folder = tmp_path / "model"
    folder.mkdir()
    for place in (folder / "inside.usda", tmp_path / "outside.usda"):
        place.write_text(USD.replace("(\n", '(\n    defaultPrim = "craft"\n', 1))
    (folder / "link.usda").symlink_to(tmp_path / "outside.usda")
    for asset, says in (("../outside.usda", "own folder"), ("./link.usda", "own folder"), ("./none.usda", "missing")):
        (folder / "stage.usda").write_text(f"#usda 1.0\n{LAYERS[kind].replace('%s', asset)}\n")
        if kind == "clip" and says == "missing":
            continue  # which usd-core leaves out
        with pytest.raises(SceneError, match=says):
            read_usd(folder / "stage.usda")
    (folder / "stage.usda").write_text(f"#usda 1.0\n{LAYERS[kind].replace('%s', './inside.usda')}\n")
    assert "header" in read_usd(folder / "stage.usda")
