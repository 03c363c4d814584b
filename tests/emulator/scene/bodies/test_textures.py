"""Textures of models: trimesh writes the files, scipy and Pillow give the values, ratios of light in closed form."""

import io
import json
import struct
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.ndimage import map_coordinates

from emulator.geometry.camera import Pinhole
from emulator.light import SceneError
from emulator.photometry.reflectance import Glossy, Hapke, Lambert, LommelSeeliger, LunarLambert, Sun
from emulator.scene.bodies.albedo import Texture, mean_albedo
from emulator.scene.bodies.gltf import WRAPS, read_gltf, transformed
from emulator.scene.bodies.mesh import build_mesh
from emulator.scene.bodies.models import load_bodies
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.trajectory.parameters import FixedPath
from tests.emulator.scene.bodies.volume import volume_m3

pytestmark = pytest.mark.usefixtures("reads_here")

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def linear(pixels):
    s = np.asarray(pixels) / 255
    return np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)


def smooth_image(height=128, width=256):
    """Return an image whose colours vary slowly, and differ by rows, columns and channels."""
    v, u = np.mgrid[:height, :width] / np.reshape([height, width], (2, 1, 1))
    waves = [np.sin(5 * u + 2 * v), np.cos(4 * v - u), np.sin(3 * u * v + 1)]
    return np.stack([(140 + 90 * wave).astype(np.uint8) for wave in waves], axis=2)


def sheet(pixels, uv=((0, 0), (1, 0), (1, 1), (0, 1)), **material):
    """Return a square of 2 m in the plane z = 0 with a texture; trimesh's v points up."""
    vertices = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    image = None if pixels is None else Image.fromarray(pixels)
    surface = trimesh.visual.material.PBRMaterial(baseColorTexture=image, **{"metallicFactor": 0.0, **material})
    visual = trimesh.visual.TextureVisuals(np.array(uv, float), material=surface)
    return trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)


def written(tmp_path, shape, change=None):
    path = tmp_path / "model.glb"
    octets = shape.export(file_type="glb")
    path.write_bytes(octets if change is None else changed(octets, change))
    return path


def changed(octets, change):
    """Return a GLB file with another JSON."""
    length = struct.unpack_from("<I", octets, 12)[0]
    document = json.loads(octets[20 : 20 + length])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + octets[20 + length :]
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def loaded(path, **more):
    found = load_bodies(BodiesParameters(bodies=(BodyTable(name="craft", shape=str(path), **more),)))
    return found.parameters.bodies[0], found.meshes[0], found.notes


def cross(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def luminance_at(mesh, law, places):
    """Return albedo times relative albedo of a mesh in the plane z = 0, between the corners of its facets."""
    a, b, c = (mesh.vertices[mesh.faces[:, k], :2] for k in range(3))
    twice = cross(b - a, c - a)
    found = np.full(len(places), np.nan)
    for n, p in enumerate(places):
        shares = np.stack([cross(b - p, c - p), cross(c - p, a - p), cross(a - p, b - p)], axis=1)
        shares /= twice[:, None]
        facet = np.argmax(shares.min(axis=1))
        found[n] = shares[facet] @ mesh.albedo[facet]
    return law.albedo * found


def test_a_texture_is_where_an_independent_reader_sees_it(tmp_path):
    """trimesh reads place and image back; scipy gives the linear luminance there."""
    factor = [200, 255, 128, 255]
    uv = [(0.1, 0.2), (0.9, 0.1), (0.8, 0.95), (0.05, 0.7)]
    path = written(tmp_path, sheet(smooth_image(), uv, baseColorFactor=factor))
    body, mesh, _ = loaded(path)
    again = trimesh.load_scene(path)
    shape = next(iter(again.geometry.values()))
    places, facets = trimesh.sample.sample_surface(shape, 300, seed=1)
    shares = trimesh.triangles.points_to_barycentric(shape.triangles[facets], places)
    u, v = np.einsum("nk,nkj->nj", shares, shape.visual.uv[shape.faces[facets]]).T
    image = np.asarray(shape.visual.material.baseColorTexture.convert("RGB"))
    grey = (linear(image) * np.array(factor[:3]) / 255) @ LUMINANCE
    at = [(1 - v) * image.shape[0] - 0.5, u * image.shape[1] - 0.5]
    truth = map_coordinates(grey, at, order=1, mode="nearest")
    found = luminance_at(mesh, body.reflectance, places[:, :2])
    np.testing.assert_allclose(found, truth, rtol=0.06)
    assert np.abs(found / truth - 1).mean() < 0.012
    assert mean_albedo(mesh) == pytest.approx(1.0)
    assert len(mesh.faces) < 5000


def test_facets_are_divided_where_the_texture_varies_and_nowhere_else(tmp_path):
    pixels = np.full((64, 64, 3), 200, np.uint8)
    pixels[:, 40:] = 60
    body, mesh, notes = loaded(written(tmp_path, sheet(pixels)))
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    sides = np.ptp(mesh.vertices[mesh.faces], axis=1).max(axis=1)
    at_edge = np.abs(middles[:, 0] - 0.25) < 2 / 64
    assert sides[at_edge].max() < 0.1
    assert sides[(middles[:, 0] > -0.75) & (middles[:, 0] < -0.25)].min() > 0.1  # repeated, its sides are edges too
    left = luminance_at(mesh, body.reflectance, np.array([[0.15, 0.3], [-0.5, 0.2]]))
    right = luminance_at(mesh, body.reflectance, np.array([[0.35, 0.3], [0.8, -0.7]]))
    np.testing.assert_allclose(left, linear(200), rtol=0.01)
    np.testing.assert_allclose(right, linear(60), rtol=0.01)
    assert not any("texture" in note for note in notes)


def test_a_closed_body_stays_closed(tmp_path):
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    box.unmerge_vertices()
    uv = np.random.default_rng(1).random((len(box.vertices), 2))  # a seam at each side
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(smooth_image()), metallicFactor=0.0)
    box.visual = trimesh.visual.TextureVisuals(uv, material=material)
    _, mesh, _ = loaded(written(tmp_path, box))
    assert len(mesh.faces) > 500
    again = build_mesh(mesh.vertices, mesh.faces)
    assert (again.open_edges, again.dropped_facets) == (0, 0)
    assert volume_m3(again) == pytest.approx(6.0)
    assert again.area_m2 == pytest.approx(22.0)


def test_light_is_in_the_ratio_of_the_texture(tmp_path):
    """Seen at right angles from far away, each half has the light of its colour; the luminance of the file is right."""
    top, bottom = halves_of_light(written(tmp_path, sheet(two_halves(), roughnessFactor=1.0)))
    np.testing.assert_allclose(top / bottom.mean(), linear(250) / linear(120), rtol=0.02)
    np.testing.assert_allclose(bottom, bottom.mean(), rtol=0.01)


def two_halves():
    pixels = np.full((32, 32, 3), 250, np.uint8)
    pixels[16:] = 120  # the lower half of the image
    return pixels


def halves_of_light(path, **more):
    """Return the light of the upper and of the lower half of a sheet that faces the camera and the Sun."""
    place = FixedPath((0.0, 0.0, 100.0), q_world_from_body=(0.0, 1.0, 0.0, 0.0))
    bodies = (BodyTable(shape=str(path), path=place, **more),)
    camera, light = Pinhole.of_field((40, 40), 1.0), np.zeros((40, 40), np.float32)
    with RasterBodies(BodiesParameters(bodies=bodies, sun=Sun((0.0, 0.0, -1.0))), camera) as drawn:
        drawn.light(0, light)
    rows = light[:, 20]
    shown = np.flatnonzero(rows > 0)
    return rows[shown[2] : shown[len(shown) // 2 - 2]], rows[shown[len(shown) // 2 + 2] : shown[-2]]


def test_metallic_and_roughness_count_by_the_mean_of_their_texture(tmp_path):
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[..., 1], pixels[:4, :, 2] = 128, 255
    image = Image.fromarray(pixels)
    shape = sheet(None, metallicRoughnessTexture=image, metallicFactor=0.5, roughnessFactor=0.8)
    header = json.loads(read_gltf(written(tmp_path, shape))["header"].tobytes())
    material = header["parts"][0]["material"]
    assert material["metallic"] == pytest.approx(0.25)
    assert material["roughness"] == pytest.approx(0.8 * 128 / 255)
    assert header["parts"][0]["texture"] is None
    assert header["notes"] == ["textures of metallic and roughness count by their mean"]


@pytest.mark.parametrize("law", [Lambert(0.3), LommelSeeliger(0.2), LunarLambert(), Hapke(), Glossy()])
def test_the_rig_s_reflectance_keeps_the_texture(tmp_path, law):
    path = written(tmp_path, sheet(two_halves(), roughnessFactor=1.0))
    body, mesh, _ = loaded(path, reflectance=law)
    assert body.reflectance == law
    assert mean_albedo(mesh) == pytest.approx(1.0)
    top, bottom = halves_of_light(path, reflectance=law)
    assert bottom.mean() > 0
    np.testing.assert_allclose(top / bottom.mean(), linear(250) / linear(120), rtol=0.02)


@pytest.mark.parametrize(("wrap", "mode"), list(zip(WRAPS, ("grid-wrap", "nearest", "reflect"), strict=True)))
def test_images_go_on_as_scipy_s_do(wrap, mode):
    image = np.random.default_rng(3).random((8, 16)).astype(np.float32)
    uv = np.random.default_rng(4).uniform(-2.5, 3.5, (500, 2))
    mean, _ = Texture(image, (wrap, wrap)).around(uv, np.ones(500))
    truth = map_coordinates(image, [uv[:, 1] * 8 - 0.5, uv[:, 0] * 16 - 0.5], order=1, mode=mode)
    np.testing.assert_allclose(mean, truth, rtol=1e-5)


def test_transforms_scale_then_turn_then_move():
    """By the extension's words: radians counter-clockwise, with v down; scale first."""
    uv = transformed(np.array([[1.0, 0.0], [0.0, 1.0]]), (0.5, 0.25), (2.0, 3.0), np.pi / 2)
    np.testing.assert_allclose(uv, [[0.5, 0.25 - 2.0], [0.5 + 3.0, 0.25]], atol=1e-12)


def test_a_black_texture_has_no_light(tmp_path):
    body, mesh, _ = loaded(written(tmp_path, sheet(np.zeros((4, 4, 3), np.uint8))))
    assert body.reflectance.albedo == 0.0
    assert mesh.albedo is None


@pytest.mark.parametrize("mode", ["L", "P", "LA", "RGBA", "I;16", "1"])
@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_images_of_every_mode_are_read(tmp_path, mode, kind):
    grey = Image.fromarray(np.full((8, 8), 255, np.uint8))
    image = Image.fromarray(np.full((8, 8), 65535, np.uint16)) if mode == "I;16" else grey.convert(mode)
    file = io.BytesIO()
    if kind == "JPEG":
        image = grey
    image.save(file, kind)
    shape = sheet(np.full((8, 8, 3), 9, np.uint8))
    (tmp_path / "skin").write_bytes(file.getvalue())
    path = written(tmp_path, shape, lambda d: d["images"].__setitem__(0, {"uri": "skin"}))
    assert loaded(path)[0].reflectance.albedo == pytest.approx(1.0, abs=1e-3)


def png(width, height):
    """Return the start of a PNG that announces so many pixels."""
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBB", 13, b"IHDR", width, height, 8, 2, 0, 0, 0) + bytes(30)


BAD = {
    "index": (lambda d: d["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"].update(index=7), "index is 7"),
    "source": (lambda d: d["textures"][0].update(source=-1), "source is -1"),
    "wrap": (lambda d: (d.update(samplers=[{"wrapS": 5}]), d["textures"][0].update(sampler=0)), "no way to go on"),
    "view": (lambda d: d["images"][0].update(bufferView=99), "bufferView is 99"),
    "outside": (lambda d: d["images"].__setitem__(0, {"uri": "../../etc/passwd"}), "own folder"),
    "missing": (lambda d: d["images"].__setitem__(0, {"uri": "no.png"}), "missing"),
    "no uv": (lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop("TEXCOORD_0"), "TEXCOORD_0"),
    "octets": (lambda d: d["images"].__setitem__(0, {"uri": "data:image/png;base64,AAAA"}), "cannot be read as PNG"),
    "huge": (lambda d: d["images"].__setitem__(0, {"uri": "huge.png"}), "cannot be read as PNG|at most"),
    "cut": (lambda d: d["images"].__setitem__(0, {"uri": "cut.png"}), "cannot be read as PNG"),
}


@pytest.mark.parametrize("name", sorted(BAD))
def test_bad_textures_are_refused(tmp_path, name):
    change, reason = BAD[name]
    (tmp_path / "huge.png").write_bytes(png(60_000, 60_000))
    (tmp_path / "cut.png").write_bytes(png(64, 64))
    with pytest.raises(SceneError, match=reason):
        read_gltf(written(tmp_path, sheet(smooth_image()), change))


def test_many_large_images_are_refused_before_they_are_decoded(tmp_path, monkeypatch):
    """Three materials with an image each, and room for two; the third is cut off in the midst of its pixels."""
    pixels = smooth_image()
    monkeypatch.setattr("emulator.scene.bodies.gltf._MOST_PIXELS", 2 * pixels.shape[0] * pixels.shape[1])

    def three(document):
        document["images"] += [document["images"][0], {"uri": "cut.png"}]
        document["textures"] += [{"source": 1}, {"source": 2}]
        primitives, materials = document["meshes"][0]["primitives"], document["materials"]
        for k in (1, 2):
            materials.append({"pbrMetallicRoughness": {"baseColorTexture": {"index": k}}})
            primitives.append(primitives[0] | {"material": k})

    whole = io.BytesIO()
    Image.fromarray(np.random.default_rng(1).integers(0, 255, (64, 64, 3), np.uint8)).save(whole, "PNG")
    (tmp_path / "cut.png").write_bytes(whole.getvalue()[:6000])
    with pytest.raises(SceneError, match=r"^image 2 has 64 x 64 pixels: .* make the images smaller"):
        read_gltf(written(tmp_path, sheet(pixels), three))


def test_a_texture_of_another_kind_is_left_out_with_a_note(tmp_path):
    def other(document):
        document["textures"][0] = {"extensions": {"KHR_texture_basisu": {"source": 0}}}

    body, mesh, notes = loaded(written(tmp_path, sheet(smooth_image()), other))
    assert mesh.albedo is None
    assert any("neither PNG nor JPEG" in note for note in notes)
    assert body.reflectance.albedo == pytest.approx(1.0)


def test_without_pillow_the_error_names_it(tmp_path, monkeypatch):
    path = written(tmp_path, sheet(smooth_image()))
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(ImportError, match="PIL"):
        read_gltf(path)
