"""Reader of glTF 2.0 files, `.gltf` and `.glb`: nodes, triangles, materials and animations, with bounds checked.

Sources: Khronos, glTF 2.0 Specification (ISO/IEC 12113), KHR_texture_transform; the transfer function of sRGB: IEC
61966-2-1. It runs in a child process, see `guarded_reader`.

Read: buffers in the file, as base64 and beside it; accessors of every component type; triangles, strips and fans;
translation, rotation, scale and matrices of nodes; base colour, metallic and roughness, by factors and textures (of
the last two the mean), PNG or JPEG; linear and cubic animations of translation and rotation.

Left out, with a note: other textures, vertex colours, emission and other properties of materials; points and lines;
skins and morph targets, which are drawn at rest. Refused: sparse or compressed accessors, required extensions that are
not known, stepped animations, animations of scale or weights.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from emulator.light import SceneError
from emulator.scene.files import reader_errors

_MOST_BYTES = 1 << 28
_MOST = {"nodes": 10_000, "parts": 256, "facets": 4_000_000, "corners": 12_000_000, "animated properties": 1024}
"""Limits of a model. A part is a node's mesh with one material."""

_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_KNOWN_EXTENSIONS = ("KHR_mesh_quantization", "KHR_materials_", "KHR_texture_transform", "KHR_lights_punctual")
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear sRGB, ITU-R BT.709
_FARTHEST_UV = 1e4  # images
_FLAT_COSINE = 0.9998  # normals within a degree of the facet's

REPEAT, CLAMP, MIRROR = 10497, 33071, 33648
WRAPS = REPEAT, CLAMP, MIRROR
"""Repetition of an image beyond its sides, of its border, and mirror images; numbers of glTF."""

_MOST_PIXELS = 1 << 27  # of all images of a model: some seconds of decoding
_MOST_OF_IMAGE = 1 << 25  # pixels
_MOST_SIDE = 1024
_LINES = 256  # of an image at a time

_Array = npt.NDArray[Any]
_Object = dict[str, Any]


def read_gltf(path: Path) -> dict[str, _Array]:
    """Return a `header` (JSON as octets: nodes, parts, channels, notes) and the arrays that it names; see `models`."""
    if path.stat().st_size > _MOST_BYTES:
        raise SceneError(f"has more than {_MOST_BYTES >> 20} MiB: simplify it, or leave out some of it")
    data = path.read_bytes()
    text, binary = _chunks(data) if data[:4] == b"glTF" else (data, None)
    return _File(_parsed(text), binary, path.parent).contents()


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON and the binary chunk of a GLB file."""
    if len(data) < 20:
        raise SceneError(f"is cut off: a GLB file has at least 20 bytes, this one {len(data)}")
    _, version, length = struct.unpack_from("<III", data)
    if version != 2:
        raise SceneError(f"is of glTF version {version}: version 2 is read")
    if length > len(data):
        raise SceneError(f"is cut off: its header announces {length} bytes, and there are {len(data)}")
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > length:
            raise SceneError(f"the chunk at byte {at} announces {size} bytes, which go beyond the end of the file")
        chunks.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    if _JSON not in chunks:
        raise SceneError("has no JSON chunk")
    return chunks[_JSON], chunks.get(_BIN)


def _parsed(text: bytes) -> _Object:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(f"its JSON cannot be read: {error}") from None
    if not isinstance(document, dict):
        raise SceneError("its JSON is no object")
    version = str(_member(document, "asset").get("version", ""))
    if not version.startswith("2"):
        raise SceneError(f"is of glTF version {version[:20]!r}: version 2 is read")
    for name in _list(document, "extensionsRequired"):
        if not str(name).startswith(_KNOWN_EXTENSIONS):
            raise SceneError(f"requires the extension {str(name)[:60]}, which is not known here: export it without")
    return document


def _member(owner: _Object, key: str) -> _Object:
    value = owner.get(key, {})
    if not isinstance(value, dict):
        raise SceneError(f"{key} is no object")
    return value


def _items(owner: _Object, key: str) -> list[_Object]:
    value = owner.get(key, [])
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise SceneError(f"{key} is no list of objects")
    return value


def _list(owner: _Object, key: str) -> list[Any]:
    value = owner.get(key, [])
    if not isinstance(value, list):
        raise SceneError(f"{key} is no list")
    return value


def _number(owner: _Object, key: str, default: int | None, below: int, where: str) -> int:
    """Return a whole number from 0, below `below`."""
    value = owner.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < below:
        raise SceneError(f"{where}: {key} is {str(value)[:40]}: it must be a whole number of 0 to {below - 1}")
    return value


def _floats(owner: _Object, key: str, default: list[float], where: str) -> list[float]:
    value = owner.get(key, default)
    is_list = isinstance(value, list) and len(value) == len(default)
    if not is_list or not all(isinstance(number, int | float) and abs(number) < 1e15 for number in value):
        raise SceneError(f"{where}: {key} must be {len(default)} finite numbers")
    return [float(number) for number in value]


def require_at_most(counted: str, count: int) -> None:
    """Raise SceneError where a model has more nodes, parts, ... than are read."""
    if count > _MOST[counted]:
        raise SceneError(f"has more than {_MOST[counted]} {counted}: join, simplify or leave out some of them")


class ModelContents:
    """Parts, arrays and notes of a model while it is read; `require_at_most` comes before allocation."""

    def __init__(self) -> None:
        self._parts: list[_Object] = []
        self._arrays: dict[str, _Array] = {}
        self._notes: dict[str, None] = {}
        self._facets = self._corners = 0

    def _keep(self, array: _Array) -> str:
        name = f"a{len(self._arrays)}"
        self._arrays[name] = array
        return name

    def _add(self, node: int, part: _Object) -> None:
        self._parts.append({"node": node, **part})
        require_at_most("parts", len(self._parts))
        self._facets += len(self._arrays[part["faces"]])
        require_at_most("facets", self._facets)
        self._corners += len(self._arrays[part["vertices"]])
        require_at_most("corners", self._corners)

    def _values(self, nodes: list[_Object], animations: list[_Object]) -> dict[str, _Array]:
        """Return the header and the arrays."""
        header = {"nodes": nodes, "parts": self._parts, "animations": animations, "notes": list(self._notes)}
        return {"header": np.frombuffer(json.dumps(header).encode(), np.uint8), **self._arrays}


class _File(ModelContents):
    """Contents of a parsed file."""

    def __init__(self, document: _Object, binary: bytes | None, folder: Path) -> None:
        super().__init__()
        self._document = document
        self._binary, self._folder = binary, folder
        self._lists: dict[str, list[_Object]] = {}
        self._buffers: dict[int, bytes] = {}
        self._pixels_left = _MOST_PIXELS
        self._luminances: dict[tuple[int, tuple[float, ...]], str] = {}
        self._means: dict[tuple[int, int], float] = {}

    def contents(self) -> dict[str, _Array]:
        """Return the header and the arrays."""
        nodes = self._nodes()
        meshes: dict[int, list[_Object]] = {}
        for k, mesh in self._meshes_of_nodes(nodes):
            if mesh not in meshes:
                meshes[mesh] = self._primitives(mesh)
            for part in meshes[mesh]:
                self._add(k, part)
        raw = self._all("animations")
        require_at_most("animated properties", sum(len(_items(animation, "channels")) for animation in raw))
        animations = [
            {"name": str(raw[k].get("name", f"animation {k}"))[:80], "channels": self._channels(raw[k], k, len(nodes))}
            for k in range(len(raw))
        ]
        return self._values(nodes, animations)

    def _all(self, kind: str) -> list[_Object]:
        """Return the file's list `kind`, checked once: a list may be long and read often."""
        if kind not in self._lists:
            self._lists[kind] = _items(self._document, kind)
        return self._lists[kind]

    def _entry(self, owner: _Object, key: str, kind: str, where: str) -> _Object:
        """Return the entry of the file's list `kind` whose number stands at a key."""
        entries = self._all(kind)
        return entries[_number(owner, key, None, len(entries), where)]

    # --- nodes

    def _nodes(self) -> list[_Object]:
        raw = self._all("nodes")
        require_at_most("nodes", len(raw))
        nodes = [self._node(node, k) for k, node in enumerate(raw)]
        for k, node in enumerate(raw):
            for child in _list(node, "children"):
                n = _number({"children": child}, "children", None, len(raw), f"node {k}")
                if nodes[n]["parent"] >= 0 or n == k:
                    raise SceneError(f"node {n} has two parents, or is its own: the nodes must be a tree")
                nodes[n]["parent"] = k
        return nodes

    def _node(self, node: _Object, k: int) -> _Object:
        where = f"node {k}"
        if "skin" in node:
            self._notes["skins are drawn at rest"] = None
        x, y, z, w = _floats(node, "rotation", [0.0, 0.0, 0.0, 1.0], where)
        if not 1e-3 < x * x + y * y + z * z + w * w < 1e3:
            raise SceneError(f"{where}: rotation is no unit quaternion")
        fields: _Object = {
            "name": str(node.get("name") or where)[:80],
            "parent": -1,
            "translation": _floats(node, "translation", [0.0, 0.0, 0.0], where),
            "rotation": [w, x, y, z],
            "scale": _floats(node, "scale", [1.0, 1.0, 1.0], where),
        }
        if "matrix" in node:
            fields["matrix"] = np.reshape(_floats(node, "matrix", [0.0] * 16, where), (4, 4)).T.tolist()
        return fields

    def _meshes_of_nodes(self, nodes: list[_Object]) -> list[tuple[int, int]]:
        """Return the nodes of the scene with a mesh, and its number."""
        raw, scenes = self._all("nodes"), self._all("scenes")
        roots = _roots(nodes)
        shown = list(range(len(nodes)))
        if scenes:
            scene = _number(self._document, "scene", 0, len(scenes), "the file")
            named = _list(scenes[scene], "nodes")
            numbers = {_number({"nodes": n}, "nodes", None, len(nodes), f"scene {scene}") for n in named}
            shown = [k for k in shown if roots[k] in numbers]
        count = len(self._all("meshes"))
        return [(k, _number(raw[k], "mesh", None, count, f"node {k}")) for k in shown if "mesh" in raw[k]]

    # --- shapes

    def _primitives(self, mesh: int) -> list[_Object]:
        primitives: list[_Object] = []
        for n, primitive in enumerate(_items(self._all("meshes")[mesh], "primitives")):
            where = f"mesh {mesh}, primitive {n}"
            mode = _number(primitive, "mode", 4, 7, where)
            if mode < 4:
                self._notes["points and lines are left out"] = None
                continue
            require_at_most("parts", len(primitives) + 1)
            primitives.append(self._primitive(primitive, mode, where))
        return primitives

    def _primitive(self, primitive: _Object, mode: int, where: str) -> _Object:
        attributes = _member(primitive, "attributes")
        if "targets" in primitive:
            self._notes["morph targets are drawn at rest"] = None
        if "COLOR_0" in attributes:
            self._notes["colours of vertices are left out"] = None
        points = self._accessor(attributes.get("POSITION"), 3, f"{where}, POSITION").astype(np.float64)
        if not np.isfinite(points).all():
            raise SceneError(f"{where}: a vertex is not finite")
        order = np.arange(len(points))
        if "indices" in primitive:
            order = self._accessor(primitive["indices"], 1, f"{where}, indices").ravel().astype(np.int64)
            if len(order) and order.max() >= len(points):
                raise SceneError(f"{where}: an index is {order.max()}, and there are {len(points)} vertices")
        faces = _triangles(order, mode)
        normals = None
        if "NORMAL" in attributes:
            normals = self._accessor(attributes["NORMAL"], 3, f"{where}, NORMAL").astype(np.float64)
            if len(normals) != len(points):
                raise SceneError(f"{where}: {len(normals)} normals for {len(points)} vertices")
        material = self._entry(primitive, "material", "materials", where) if "material" in primitive else None
        return {
            "vertices": self._keep(points),
            "faces": self._keep(faces),
            "is_flat": _is_flat(points, faces, normals),
            "material": None if material is None else self._shares(material, where),
            "texture": None if material is None else self._texture(material, attributes, len(points), where),
        }

    def _shares(self, material: _Object, where: str) -> _Object:
        """Return luminance of the base colour's factor, metallic and roughness, each 0 to 1."""
        surface = _member(material, "pbrMetallicRoughness")
        if any(key.endswith("Texture") for key in material):
            self._notes["textures of normals, occlusion and emission are left out"] = None
        if any(_list(material, "emissiveFactor")) or _member(material, "extensions"):
            self._notes["emission and extensions of materials are left out"] = None
        if material.get("alphaMode", "OPAQUE") != "OPAQUE":
            self._notes["transparent materials are drawn opaque"] = None
        colour = _floats(surface, "baseColorFactor", [1.0, 1.0, 1.0, 1.0], where)
        shares = {
            "luminance": float(LUMINANCE @ colour[:3]),
            "metallic": _floats({"m": [surface.get("metallicFactor", 1.0)]}, "m", [1.0], where)[0],
            "roughness": _floats({"r": [surface.get("roughnessFactor", 1.0)]}, "r", [1.0], where)[0],
        }
        if not all(0 <= share <= 1 + 1e-6 for share in (*shares.values(), *colour)):
            raise SceneError(f"{where}: the factors of its material must be 0 to 1")
        for key, channel in (("roughness", 1), ("metallic", 2)):
            shares[key] *= self._mean(surface, channel, where)
        return {key: min(share, 1.0) for key, share in shares.items()}

    # --- textures: luminance of the linear colour, at most _MOST_SIDE pixels on a side, powers of two

    def _mean(self, surface: _Object, channel: int, where: str) -> float:
        """Return the mean of a channel of the texture of metallic and roughness, 1 without one."""
        texture = self._image(surface, "metallicRoughnessTexture", where)
        if texture is None:
            return 1.0
        self._notes["textures of metallic and roughness count by their mean"] = None
        if (texture[0], channel) not in self._means:
            pixels = self._pixels(texture[0])
            self._means |= {(texture[0], k): float(pixels[:, :, k].mean()) / 255 for k in (1, 2)}
        return self._means[texture[0], channel]

    def _texture(self, material: _Object, attributes: _Object, count: int, where: str) -> _Object | None:
        """Return the base colour's `luminance`, `uv` of vertices, by the names of arrays, and `wraps`."""
        surface = _member(material, "pbrMetallicRoughness")
        placement = self._image(surface, "baseColorTexture", where)
        if placement is None:
            return None
        image, wraps = placement
        info = _member(surface, "baseColorTexture")
        transform = _member(_member(info, "extensions"), "KHR_texture_transform")
        number = _number({"texCoord": transform.get("texCoord", info.get("texCoord", 0))}, "texCoord", 0, 100, where)
        name = f"TEXCOORD_{number}"
        uv = self._accessor(attributes.get(name), 2, f"{where}, {name}").astype(np.float64)
        if len(uv) != count or not (np.abs(uv) < _FARTHEST_UV).all():
            raise SceneError(f"{where}: {name} must be {count} finite places, within {_FARTHEST_UV:g} images")
        offset, scale = _floats(transform, "offset", [0, 0], where), _floats(transform, "scale", [1, 1], where)
        angle = _floats({"rotation": [transform.get("rotation", 0.0)]}, "rotation", [0.0], where)[0]
        uv = transformed(uv, offset, scale, angle)
        weights = tuple(LUMINANCE * _floats(surface, "baseColorFactor", [1.0, 1.0, 1.0, 1.0], where)[:3])
        if (image, weights) not in self._luminances:
            self._luminances[image, weights] = self._keep(base_colour(self._pixels(image), weights))
        return {"luminance": self._luminances[image, weights], "uv": self._keep(uv), "wraps": wraps}

    def _image(self, surface: _Object, key: str, where: str) -> tuple[int, list[int]] | None:
        """Return the number of a texture's image and how it goes on along u and v; None: there is none."""
        if key not in surface:
            return None
        where = f"{where}, {key}"
        texture = self._entry(_member(surface, key), "index", "textures", where)
        if "source" not in texture:
            self._notes["textures that are neither PNG nor JPEG are left out"] = None
            return None
        image = _number(texture, "source", None, len(self._all("images")), where)
        sampler = self._entry(texture, "sampler", "samplers", where) if "sampler" in texture else {}
        wraps = [_number(sampler, axis, REPEAT, 1 << 16, where) for axis in ("wrapS", "wrapT")]
        if not set(wraps) <= set(WRAPS):
            raise SceneError(f"{where}: {wraps} is no way to go on beyond an image: {WRAPS}")
        return image, wraps

    def _pixels(self, image: int) -> npt.NDArray[np.uint8]:
        entry, where = self._all("images")[image], f"image {image}"
        if "uri" in entry:
            data = self._loaded(str(entry["uri"]), where)
        else:
            data = self._view(self._entry(entry, "bufferView", "bufferViews", where), where)
        pixels = decoded(data, where, self._pixels_left)
        self._pixels_left -= pixels.shape[0] * pixels.shape[1]
        return pixels

    # --- animations

    def _channels(self, animation: _Object, k: int, nodes: int) -> list[_Object]:
        samplers, channels = _items(animation, "samplers"), []
        for n, channel in enumerate(_items(animation, "channels")):
            where = f"animation {k}, channel {n}"
            target = _member(channel, "target")
            if "node" not in target:
                continue
            node = _number(target, "node", None, nodes, where)
            sampler = samplers[_number(channel, "sampler", None, len(samplers), where)]
            channels.append({"node": node, **self._track(sampler, str(target.get("path"))[:20], where)})
        return channels

    def _track(self, sampler: _Object, path: str, where: str) -> _Object:
        if path not in ("translation", "rotation"):
            raise SceneError(f"{where}: {path} is animated: bodies are rigid; animate translation and rotation")
        interpolation = str(sampler.get("interpolation", "LINEAR"))[:20]
        if interpolation not in ("LINEAR", "CUBICSPLINE"):
            raise SceneError(f"{where}: interpolation {interpolation} jumps: export it as LINEAR or CUBICSPLINE")
        times = self._accessor(sampler.get("input"), 1, f"{where}, input").ravel().astype(np.float64)
        width = 3 if path == "translation" else 4
        values = self._accessor(sampler.get("output"), width, f"{where}, output").astype(np.float64)
        per_time = 3 if interpolation == "CUBICSPLINE" else 1
        if not len(times) or len(values) != per_time * len(times):
            raise SceneError(f"{where}: {len(times)} times and {len(values)} values do not fit")
        if not (np.isfinite(times).all() and np.isfinite(values).all() and (np.diff(times) > 0).all()):
            raise SceneError(f"{where}: its times must increase, and all its numbers be finite")
        if times[0] < 0 or times[-1] > 1e9:
            raise SceneError(f"{where}: its times must be 0 to 1e9 s")
        values = values.reshape(len(times), per_time, width)
        if path == "rotation":
            values = np.roll(values, 1, axis=2)
            lengths = np.linalg.norm(values[:, per_time // 2], axis=1)
            if ((lengths < 0.9) | (lengths > 1.1)).any():
                raise SceneError(f"{where}: a rotation is no unit quaternion")
            if per_time == 1:
                values /= lengths[:, None, None]
        return {"path": path, "times": self._keep(times), "values": self._keep(values)}

    # --- bytes

    def _accessor(self, number: object, width: int, where: str) -> _Array:
        """Return the numbers of an accessor, (count, width); normalised ones are 0 to 1 or -1 to 1."""
        a = self._entry({"accessor": number}, "accessor", "accessors", where)
        if "sparse" in a or "bufferView" not in a:
            raise SceneError(f"{where}: sparse or compressed data: export it without")
        kind = _TYPES.get(_number(a, "componentType", None, 1 << 16, where))
        if kind is None or _WIDTHS.get(str(a.get("type"))) != width:
            raise SceneError(f"{where}: {a.get('type')!s:.20} of {a.get('componentType')!s:.20} does not belong here")
        view = self._entry(a, "bufferView", "bufferViews", where)
        data = self._view(view, where)
        size = np.dtype(kind).itemsize * width
        stride = _number(view, "byteStride", size, 253, where) if "byteStride" in view else size
        start, count = _number(a, "byteOffset", 0, 1 << 40, where), _number(a, "count", None, 1 << 40, where)
        if stride < size or (count and start + (count - 1) * stride + size > len(data)):
            raise SceneError(f"{where}: {count} items do not fit into the {len(data)} bytes of their buffer view")
        require_at_most("corners", count)
        rows = np.ndarray((count, width), kind, data, start, (stride, np.dtype(kind).itemsize)).copy()
        if a.get("normalized") and rows.dtype.kind in "iu":
            return np.maximum(rows / np.iinfo(rows.dtype).max, -1.0)
        return rows

    def _view(self, view: _Object, where: str) -> bytes:
        count = len(self._all("buffers"))
        data = self._buffer(_number(view, "buffer", None, count, where))
        start, length = (_number(view, key, 0, 1 << 40, where) for key in ("byteOffset", "byteLength"))
        if start + length > len(data):
            raise SceneError(f"{where}: its buffer view ends at byte {start + length} of {len(data)}")
        return data[start : start + length]

    def _buffer(self, k: int) -> bytes:
        if k not in self._buffers:
            uri = self._all("buffers")[k].get("uri")
            data = self._binary if uri is None else self._loaded(str(uri), f"buffer {k}")
            if data is None:
                raise SceneError(f"buffer {k} has no data")
            self._buffers[k] = data
        return self._buffers[k]

    def _loaded(self, uri: str, where: str) -> bytes:
        if uri.startswith("data:"):
            head, _, text = uri.partition(",")
            try:
                return base64.b64decode(text if head.endswith(";base64") else "?", validate=True)
            except binascii.Error:
                raise SceneError(f"{where} is no base64 text") from None
        path = (self._folder / unquote(uri)).resolve()
        if "://" in uri or not path.is_relative_to(self._folder.resolve()):
            raise SceneError(f"{where} is {uri[:80]!r}: files are read from the model's own folder alone")
        if not path.is_file():
            raise SceneError(f"{where} is the file {uri[:80]!r}, which is missing")
        if path.stat().st_size > _MOST_BYTES:
            raise SceneError(f"{where} has more than {_MOST_BYTES >> 20} MiB")
        return path.read_bytes()


def _roots(nodes: list[_Object]) -> list[int]:
    """Return the node at the top of each node's chain of parents; raises SceneError for a circle."""
    parents = np.array([node["parent"] for node in nodes], np.intp)
    above = np.where(parents < 0, np.arange(len(nodes)), parents)
    for _ in range(len(nodes).bit_length()):
        above = above[above]  # each look goes twice as far
    circling = np.flatnonzero(parents[above] >= 0)
    if circling.size:
        raise SceneError(f"node {circling[0]} is its own ancestor, or below such a node: the nodes must be a tree")
    return list(map(int, above))


def _triangles(order: _Array, mode: int) -> _Array:
    """Return (m, 3) corners of a list (4), a strip (5) or a fan (6) of triangles."""
    if mode == 4:
        return np.asarray(order[: len(order) // 3 * 3].reshape(-1, 3))
    if len(order) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == 6:
        return np.stack([order[1:-1], order[2:], np.full(len(order) - 2, order[0])], axis=1)
    strip = np.stack([order[:-2], order[1:-1], order[2:]], axis=1)
    strip[1::2] = strip[1::2][:, [0, 2, 1]]
    return strip


def _is_flat(points: _Array, faces: _Array, normals: _Array | None) -> bool:
    """Return whether each facet is to be drawn flat: without normals, or with those of the facets."""
    if normals is None or not len(faces):
        return True
    a, b, c = (points[faces[:, k]] for k in range(3))
    facet = np.cross(b - a, c - a)
    lengths = np.linalg.norm(facet, axis=1)[:, None] * np.linalg.norm(normals[faces], axis=2)
    with np.errstate(all="ignore"):
        cosines = np.einsum("mj,mkj->mk", facet, normals[faces]) / lengths
    return not bool((cosines < _FLAT_COSINE).any())


def decoded(data: bytes, where: str, most_pixels: int) -> npt.NDArray[np.uint8]:
    """Return red, green and blue, (height, width, 3), of a PNG or JPEG within limits; raises SceneError."""
    from PIL import Image  # an extra; in the child process alone

    formats, fault = ("PNG", "JPEG"), f"{where} cannot be read as PNG or JPEG"
    with reader_errors(fault), Image.open(io.BytesIO(data), formats=formats) as image:
        if image.width * image.height > min(_MOST_OF_IMAGE, most_pixels):
            raise SceneError(
                f"{where} has {image.width} x {image.height} pixels: at most {_MOST_OF_IMAGE} of one image and "
                f"{_MOST_PIXELS} of all are read, {_MOST_SIDE} on a side are used; make the images smaller"
            )
        if image.mode.startswith("I"):  # 16 bit grey, which Pillow would cut off at 255
            grey = np.asarray(image) >> 8
            return np.repeat(grey.astype(np.uint8)[:, :, None], 3, axis=2)
        return np.asarray(image.convert("RGB"))


def base_colour(pixels: npt.NDArray[np.uint8], weights: Sequence[float]) -> npt.NDArray[np.float32]:
    """Return the luminance of sRGB pixels, (height, width) powers of two, with linear `weights` of red, green, blue."""
    from PIL import Image

    s = np.arange(256) / 255
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    tables = [(weight * linear).astype(np.float32) for weight in weights]
    out: npt.NDArray[np.float32] = np.empty(pixels.shape[:2], np.float32)
    for start in range(0, len(out), _LINES):
        part = pixels[start : start + _LINES]
        out[start : start + _LINES] = sum(table[part[:, :, k]] for k, table in enumerate(tables))
    height, width = (min(1 << max(side - 1, 0).bit_length(), _MOST_SIDE) for side in out.shape)
    if (height, width) == out.shape:
        return out
    return np.asarray(Image.fromarray(out).resize((width, height), Image.Resampling.BILINEAR))


def transformed(uv: _Array, offset: Sequence[float], scale: Sequence[float], angle_rad: float) -> _Array:
    """Return coordinates (n, 2) by the transform of KHR_texture_transform.

    Scale comes first; the rotation is counter-clockwise as one sees the image, whose v points down. The GLSL in the
    specification turns the other way (issue 1563 of its repository); other readers and its model of tests do as here.
    """
    u, v = uv[:, 0] * scale[0], uv[:, 1] * scale[1]
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    return np.stack([offset[0] + cosine * u + sine * v, offset[1] - sine * u + cosine * v], axis=1)
