"""Bodies of model files, glTF 2.0 and USD: a node with a mesh becomes a body, an animation of nodes its path.

    in the file                                 in the scene
    x, y, z in metres (glTF: y is up)           x, y, z of the body's frame, times units_m; its axes are the file's
    a node with a mesh                          a body NAME/NODE, one for each material of it
    a node that moves, or is below such a one   the same, on a path of joints, see `emulator.trajectory.joints`
    scale, also uneven, and still transforms    in the vertices; but above a moving node scale must be even
    time 0 of the animation                     time 0 of the scene; before the first key and after the last it rests

Bodies that do not move against each other are fixed to the first of them, so they cast shadows as one. The still ones
come first and follow the body's own path; the moving ones are fixed to them.

Materials become the laws of reflection `glossy`, with the luminance Y of the (linear) base colour, M metallic and R
roughness (glTF 2.0, appendix B; Karis 2013 for the exponent of Blinn's lobe from Trowbridge and Reitz's width R^2):

    albedo = Y (1 - M)      shine = 0.04 (1 - M) + Y M      sharpness = 2 / R^4 - 2, held between 1 and 1e5

A texture of the base colour gives the surface its albedo, and Y is its mean over the surface, see `painting`.

A node without a material, and every node where the rig's `reflectance` is not the default, has that of the rig; a
texture is then the albedo relative to its mean.
Fresnel's brightening at grazing angles and the shadowing of roughness are left out, so a rough metal (R above 0.84) is
a wide lobe about the mirror's direction.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import matrix_of, quaternion_of
from emulator.light import SceneError
from emulator.photometry.reflectance import Glossy, LommelSeeliger
from emulator.scene.bodies.albedo import Texture, painted
from emulator.scene.bodies.mesh import Mesh, build_mesh, find_shape, load_mesh
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.scene.files import read_in_child
from emulator.trajectory.joints import Joint, JointPath, Track
from emulator.trajectory.parameters import FixedPath, TrajectoryParameters
from emulator.trajectory.pose import Pose
from firmware_protocol.events import Floats
from transports.guarded_reader import Limits

_USD = "emulator.scene.bodies.usd:read_usd"
_USD_BYTES = 2 << 30  # address space that its library and its threads take

MODEL_READERS = {
    ".glb": "emulator.scene.bodies.gltf:read_gltf",
    ".gltf": "emulator.scene.bodies.gltf:read_gltf",
} | dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), _USD)
"""The function that reads a model in the child process, by the file's suffix."""

_MOST_PAINTED = 60_000
_FINE = f"parts of its textures are finer than {_MOST_PAINTED} facets can show: they have their mean there"
_EVEN = 1e-6
_DIELECTRIC = 0.04

_Array = npt.NDArray[Any]
_Tracks = dict[int, dict[str, Track]]


class Bodies(NamedTuple):
    """The bodies of a scene with their shapes.

    Attributes
    ----------
    parameters : the scene's, with a body for each node of a model.
    meshes : of each body.
    notes : remarks on what was left out of the models, and on faults of the shapes.
    """

    parameters: BodiesParameters
    meshes: list[Mesh]
    notes: list[str]


def load_bodies(parameters: BodiesParameters) -> Bodies:
    """Return the bodies of a scene, each node of a model file as one; raises SceneError."""
    bodies: list[tuple[BodyTable, Mesh]] = []
    notes: list[str] = []
    names = [body.name for body in parameters.bodies if body.name]
    for body in parameters.bodies:
        path = find_shape(body.shape)
        if path.suffix.lower() in MODEL_READERS:
            model = read_model(path)
            bodies += _bodies(body, model, _unused(body.name or path.stem, names, is_given=bool(body.name)))
            notes += [f"{body.shape}: {note}" for note in model.header["notes"]]
        else:
            mesh = load_mesh(path, body.units_m)
            bodies.append((body, mesh))
            notes += [f"{body.shape}: {warning}" for warning in mesh.warnings]
    tables, meshes = zip(*bodies, strict=True)
    return Bodies(replace(parameters, bodies=tables), list(meshes), notes)


def _unused(name: str, names: list[str], *, is_given: bool) -> str:
    """Return a name that no body has yet, and add it to `names`."""
    number, unused = 1, name
    while not is_given and unused in names:
        number += 1
        unused = f"{name} {number}"
    names.append(unused)
    return unused


@dataclass(frozen=True, eq=False)
class Model:
    """A model file as its reader returns it.

    Attributes
    ----------
    path : the file.
    header : nodes (name, parent, translation, rotation with the scalar first, scale, perhaps matrix), parts (node,
        vertices, faces, is_flat, material, texture), animations (name, channels), notes.
    arrays : by the names in the header.
    """

    path: Path
    header: dict[str, Any]
    arrays: dict[str, _Array]


def read_model(path: Path) -> Model:
    """Read a model file in a child process; raises SceneError with its name."""
    reader, limits = MODEL_READERS[path.suffix.lower()], None
    if reader == _USD and path.is_file():
        usual = Limits.of(path)
        limits = Limits(usual.memory_bytes + _USD_BYTES, usual.cpu_s)
    arrays = read_in_child(reader, path, limits)
    header = json.loads(arrays.pop("header").tobytes())
    if not header["parts"]:
        raise SceneError(f"{path}: no node of it has a mesh of triangles")
    return Model(path, header, arrays)


def law_of(material: dict[str, float]) -> Glossy:
    """Return the law of reflection of a material: luminance, metallic and roughness, each 0 to 1."""
    luminance, metallic = material["luminance"], material["metallic"]
    width2 = max(material["roughness"], 0.01) ** 4
    shine = _DIELECTRIC * (1 - metallic) + luminance * metallic
    return Glossy(luminance * (1 - metallic), shine, min(max(2 / width2 - 2, 1.0), 1e5))


def _bodies(body: BodyTable, model: Model, name: str) -> list[tuple[BodyTable, Mesh]]:
    """Return the bodies of a model: the still ones first, then those of each joint."""
    tracks, period_s = _tracks(body, model)
    chains = _chains(model, tracks)
    groups: dict[tuple[int, ...], list[int]] = {}
    for number, part in enumerate(model.header["parts"]):
        groups.setdefault(chains[part["node"]].moving, []).append(number)
    bodies: list[tuple[BodyTable, Mesh]] = []
    for moving in sorted(groups):
        joints, frame = _joints(moving, model, tracks, chains, body.units_m)
        first = replace(body, name=_named(name, model, groups[moving][0])) if bodies else replace(body, name=name)
        if moving:
            first = _moving(first, model, JointPath(joints, period_s), name if () in groups else "")
        for number in groups[moving]:
            part = model.header["parts"][number]
            table = first
            if number != groups[moving][0]:
                table = replace(first, name=_named(name, model, number), path=FixedPath(), fixed_to=first.name)
            mesh, material = _covered(body, model, part, frame @ chains[part["node"]].still)
            law = law_of(material) if material else body.reflectance
            smooth = body.smooth and not part["is_flat"]
            bodies.append((replace(table, reflectance=law, smooth=smooth), mesh))
    return bodies


def _moving(first: BodyTable, model: Model, path: JointPath, root: str) -> BodyTable:
    """Return the table of a joint's first body, fixed to the model's still body `root`, if there is one."""
    if root:
        return replace(first, path=cast(TrajectoryParameters, path), fixed_to=root)
    still = first.path
    if not isinstance(still, FixedPath) or still.look_at_m is not None:
        raise SceneError(
            f"{model.path}: every node of it moves, so its body can have no path of kind {still.kind!r}: add a node "
            "with a mesh that does not move, or give the body a fixed place"
        )
    base = Pose(np.array(still.position_m), np.array(still.q_world_from_body))
    return replace(first, path=cast(TrajectoryParameters, replace(path, base=base)))


def _named(name: str, model: Model, number: int) -> str:
    """Return the name of a part: the model's, the node's and, where parts would share it, a number."""
    nodes, parts = model.header["nodes"], model.header["parts"]
    label = nodes[parts[number]["node"]]["name"]
    same = sum(nodes[part["node"]]["name"] == label for part in parts[:number])
    return f"{name}/{label} {same + 1}" if same else f"{name}/{label}"


def _covered(
    body: BodyTable, model: Model, part: dict[str, Any], matrix: Floats
) -> tuple[Mesh, dict[str, float] | None]:
    """Return a part's shape with its texture in its body's frame, and its material; None: the rig gives the law."""
    mesh, uv = _mesh(model, part, matrix)
    material = part["material"] if body.reflectance == LommelSeeliger() else None
    if uv is None:
        return mesh, material
    textured = sum(other.get("texture") is not None for other in model.header["parts"])
    texture = Texture(model.arrays[part["texture"]["luminance"]], tuple(part["texture"]["wraps"]))
    mesh, luminance, is_whole = painted(mesh, uv, texture, len(mesh.faces) + _MOST_PAINTED // textured)
    notes = model.header["notes"]
    if not is_whole and _FINE not in notes:
        notes.append(_FINE)
    return mesh, material and material | {"luminance": min(luminance, 1.0)}


def _mesh(model: Model, part: dict[str, Any], matrix: Floats) -> tuple[Mesh, Floats | None]:
    """Return a part's shape, and the place in its texture of each corner, (m, 3, 2); None: it has no texture.

    Its winding, which gives the outside, is taken from the file.
    """
    points = model.arrays[part["vertices"]] @ matrix[:3, :3].T + matrix[:3, 3]
    faces = model.arrays[part["faces"]]
    faces = faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces
    try:
        mesh = build_mesh(points, faces, np.arange(len(faces), dtype=np.float64), turns=False)
    except SceneError as error:
        name = model.header["nodes"][part["node"]]["name"]
        raise SceneError(f"{model.path}: node {name!r}: {error}") from error
    kept = np.asarray(mesh.albedo)[:, 0].astype(np.int64)  # facets without area are dropped
    texture = part.get("texture")
    return replace(mesh, albedo=None), model.arrays[texture["uv"]][faces[kept]] if texture else None


class _Chain(NamedTuple):
    """Nodes from the root to a node: those that move, and the product (4, 4) of transforms below the last of them."""

    moving: tuple[int, ...]
    still: Floats


def _chains(model: Model, tracks: _Tracks) -> dict[int, _Chain]:
    """Return the chain of each node with a part, and of each node above it; a chain may have 10 000 nodes."""
    nodes, chains = model.header["nodes"], {-1: _Chain((), np.eye(4))}
    for part in model.header["parts"]:
        k, without = part["node"], []
        while k not in chains:
            without.append(k)
            k = nodes[k]["parent"]
        for k in reversed(without):
            moving, still = chains[nodes[k]["parent"]]
            chains[k] = _Chain((*moving, k), np.eye(4)) if k in tracks else _Chain(moving, still @ _local(nodes[k]))
    return chains


def _local(node: dict[str, Any]) -> Floats:
    if "matrix" in node:
        return np.asarray(node["matrix"], np.float64)
    matrix = np.eye(4)
    matrix[:3, :3] = matrix_of(_unit(node["rotation"])) * node["scale"]
    matrix[:3, 3] = node["translation"]
    return matrix


def _unit(q: Sequence[float]) -> Floats:
    return np.asarray(np.array(q) / np.linalg.norm(q))


def _tracks(body: BodyTable, model: Model) -> tuple[_Tracks, float]:
    """Return the tracks of each node that moves, and the period in seconds, 0 where nothing repeats."""
    animations = model.header["animations"]
    names = [animation["name"] for animation in animations]
    if body.animation and body.animation not in names:
        raise SceneError(f"{model.path}: no animation {body.animation!r}: it has {', '.join(names) or 'none'}")
    tracks: _Tracks = {}
    for animation in animations:
        for channel in animation["channels"] if body.animation in ("", animation["name"]) else ():
            node = model.header["nodes"][channel["node"]]
            if channel["path"] in tracks.setdefault(channel["node"], {}) or "matrix" in node:
                fault = "has a matrix" if "matrix" in node else f"is moved twice: choose one `animation` of {names}"
                raise SceneError(f"{model.path}: node {node['name']!r} {fault}")
            tracks[channel["node"]][channel["path"]] = _track(model, channel)
    every = [track for of_node in tracks.values() for track in of_node.values()]
    if not body.repeat or not every:
        return tracks, 0.0
    period_s = max(float(track.times_s[-1]) for track in every)
    if period_s < 1e-6 or not all(_closes(track) for track in every):
        raise SceneError(f"{model.path}: its animation ends elsewhere than it begins, so it cannot `repeat`")
    return tracks, period_s


def _track(model: Model, channel: dict[str, Any]) -> Track:
    times_s, values = model.arrays[channel["times"]], model.arrays[channel["values"]]
    if values.shape[1] == 1:
        return Track(times_s, values[:, 0])
    return Track(times_s, values[:, 1], values[:, [0, 2]])


def _closes(track: Track) -> bool:
    first, last = track.values[0], track.values[-1]
    off = min(np.abs(first - last).max(), np.abs(first + last).max() if len(first) == 4 else np.inf)
    return bool(off <= 1e-4 * max(1.0, np.abs(track.values).max()))


def _joints(
    moving: Sequence[int], model: Model, tracks: _Tracks, chains: dict[int, _Chain], units_m: float
) -> tuple[tuple[Joint, ...], Floats]:
    """Return the joints of a chain of moving nodes, and the scale of what is fixed to the last of them, (4, 4)."""
    nodes, joints = model.header["nodes"], []
    frame = np.diag([units_m, units_m, units_m, 1.0])
    for k in moving:
        frame = frame @ chains[nodes[k]["parent"]].still
        fixed, scale = _split(frame, nodes[k]["name"], model)
        still = {
            "translation": Track(np.zeros(1), np.array([nodes[k]["translation"]])),
            "rotation": Track(np.zeros(1), _unit(nodes[k]["rotation"])[None]),
        }
        motion = still | tracks[k]
        place = motion["translation"]
        tangents = None if place.tangents is None else place.tangents * scale
        joints.append(Joint(fixed, Track(place.times_s, place.values * scale, tangents), motion["rotation"]))
        frame = np.diag([*(scale * np.array(nodes[k]["scale"])), 1.0])
    return tuple(joints), frame


def _split(frame: Floats, name: str, model: Model) -> tuple[Pose, float]:
    """Return a transform as a pose and an even scale that comes before it."""
    linear = frame[:3, :3]
    determinant = float(np.linalg.det(linear))
    scale = float(np.cbrt(determinant))
    if not scale > 0 or np.abs(linear.T @ linear / scale**2 - np.eye(3)).max() > _EVEN:
        raise SceneError(
            f"{model.path}: the scale above the moving node {name!r} is uneven, mirrored or 0: it would bend what "
            "moves; apply the scale to the vertices"
        )
    return Pose(frame[:3, 3], quaternion_of(linear / scale)), scale
