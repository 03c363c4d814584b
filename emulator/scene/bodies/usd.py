"""Reader of USD stages (`.usd`, `.usda`, `.usdc`, `.usdz`), by usd-core, in a child process; see `guarded_reader`.

It returns the same as the reader of glTF. Read: meshes, with facets cut into triangles around their first corner;
transforms of prims, also over time; `metersPerUnit`, as a scale of the whole stage; colour, metallic and roughness of a
UsdPreviewSurface. Axes are those of the file, whatever its `upAxis`. Time 0 is the stage's start time.

Transforms over time are sampled and joined as in glTF, by straight lines and slerp. Between the stage's own samples as
many are taken as keep the pose half-way between them within 1e-5 rad and 1e-5 of the place's range.

Layers are read from the file's own folder alone, which is checked before one is opened; for clips of values afterwards.

Left out, with a note: spheres, cubes and other shapes without a mesh, textures. Subdivision surfaces are their cages.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import quaternion_of
from emulator.light import SceneError
from emulator.scene.bodies.gltf import LUMINANCE, ModelContents, require_at_most

_WITHIN = 1e-5
_MOST_SAMPLES = 1 << 14

_Array = npt.NDArray[Any]
_Object = dict[str, Any]
_Pose = tuple[_Array, _Array, _Array]  # translation, quaternion, scale
_STILL: _Pose = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.ones(3)


def read_usd(path: Path) -> dict[str, _Array]:
    """Return a `header` and arrays as `gltf.read_gltf` does; raises SceneError."""
    from pxr import Sdf, Usd  # in the child process alone

    checked: set[str] = set()
    pending = [str(path)]
    while pending:
        layer = Sdf.Layer.FindOrOpen(pending.pop())
        if layer is None:
            raise SceneError("cannot be read as a USD layer, or a layer that it names cannot")
        named = {layer.ComputeAbsolutePath(asset) for asset in layer.GetCompositionAssetDependencies()} - checked
        for place in named:
            _require_inside(place, path.parent)
        checked |= named
        pending += named
    stage = Usd.Stage.Open(str(path))
    values = _Stage(stage).contents()
    for layer in stage.GetUsedLayers(includeClipLayers=True):
        _require_inside(layer.realPath or str(path), path.parent)
    return values


def _require_inside(place: str, folder: Path) -> None:
    """Raise SceneError where a layer that a stage names is missing, or outside the stage's folder."""
    from pxr import Ar

    file = Path(Ar.SplitPackageRelativePathOuter(place)[0]).resolve()
    if not file.is_relative_to(folder.resolve()):
        raise SceneError(f"names the layer {place[-80:]!r}: files are read from the model's own folder alone")
    if not file.is_file():
        raise SceneError(f"names the layer {place[-80:]!r}, which is missing")


class _Stage(ModelContents):
    """Contents of an open stage."""

    def __init__(self, stage: Any) -> None:
        from pxr import UsdGeom

        super().__init__()
        self._stage = stage
        self._start = stage.GetStartTimeCode() if stage.HasAuthoredMetadata("startTimeCode") else 0.0
        unit_m = float(UsdGeom.GetStageMetersPerUnit(stage))
        self._nodes = [_node("stage", -1, (*_STILL[:2], np.full(3, unit_m)))]
        self._channels: list[_Object] = []

    def contents(self) -> dict[str, _Array]:
        """Return the header and the arrays."""
        from pxr import Usd, UsdGeom

        numbers = {self._stage.GetPseudoRoot().GetPath(): 0}
        prims = iter(Usd.PrimRange(self._stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))
        for prim in prims:
            if prim.IsPseudoRoot():
                continue
            imageable = UsdGeom.Imageable(prim)
            if imageable and (imageable.ComputeVisibility() == "invisible" or imageable.ComputePurpose() == "guide"):
                prims.PruneChildren()
                continue
            numbers[prim.GetPath()] = self._prim(prim, numbers[prim.GetPath().GetParentPath()])
        animations = [{"name": "stage", "channels": self._channels}] if self._channels else []
        return self._values(self._nodes, animations)

    def _prim(self, prim: Any, parent: int) -> int:
        """Append a prim as a node; return its number."""
        from pxr import UsdGeom

        number, transform = len(self._nodes), UsdGeom.Xformable(prim)
        node = _node(prim.GetName(), 0 if transform and transform.GetResetXformStack() else parent, _STILL)
        self._nodes.append(node)
        require_at_most("nodes", len(self._nodes))
        if transform and transform.TransformMightBeTimeVarying():
            self._move(transform, node, number)
        elif transform:
            node["matrix"] = np.array(transform.GetLocalTransformation()).T.tolist()
        if prim.IsA(UsdGeom.Mesh):
            require_at_most("parts", len(self._parts) + 1)
            self._add(number, self._part(UsdGeom.Mesh(prim), prim.GetName()))
        elif prim.IsA(UsdGeom.Gprim):
            self._notes["shapes without a mesh are left out"] = None
        return number

    def _move(self, transform: Any, node: _Object, number: int) -> None:
        require_at_most("animated properties", len(self._channels) + 2)
        codes, poses = _sampled(transform, node["name"])
        node |= _node(node["name"], node["parent"], poses[0])
        times = (codes - self._start) / self._stage.GetTimeCodesPerSecond()
        for path, k in (("translation", 0), ("rotation", 1)):
            values = np.array([pose[k] for pose in poses])[:, None]
            track = {"times": self._keep(times), "values": self._keep(values)}
            self._channels.append({"node": number, "path": path, **track})

    def _part(self, mesh: Any, name: str) -> _Object:
        points = np.array(mesh.GetPointsAttr().Get() or [], np.float64).reshape(-1, 3)
        counts = np.array(mesh.GetFaceVertexCountsAttr().Get() or [], np.int64)
        corners = np.array(mesh.GetFaceVertexIndicesAttr().Get() or [], np.int64)
        if (counts < 3).any() or counts.sum() != len(corners):
            raise SceneError(f"mesh {name!r}: its counts of corners do not fit its {len(corners)} corners")
        first = np.repeat(np.cumsum(counts) - counts, counts - 2)
        fan = np.arange(len(first)) - np.repeat(np.cumsum(counts - 2) - (counts - 2), counts - 2)
        faces = corners[np.stack([first, first + fan + 1, first + fan + 2], axis=1)]
        if mesh.GetOrientationAttr().Get() == "leftHanded":
            faces = faces[:, ::-1]
        is_smooth = mesh.GetNormalsAttr().HasAuthoredValue() and mesh.GetNormalsInterpolation() == "vertex"
        return {
            "vertices": self._keep(points),
            "faces": self._keep(np.ascontiguousarray(faces)),
            "is_flat": not is_smooth,
            "material": self._material(mesh.GetPrim()),
        }

    def _material(self, prim: Any) -> _Object | None:
        """Return luminance, metallic and roughness of its UsdPreviewSurface; None: it has none."""
        from pxr import UsdShade

        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
        surface = material.ComputeSurfaceSource()[0] if material else None
        if not surface or surface.GetIdAttr().Get() != "UsdPreviewSurface":
            return None
        inputs = {}
        for name, default in (("diffuseColor", (0.18, 0.18, 0.18)), ("metallic", 0.0), ("roughness", 0.5)):
            value = surface.GetInput(name)
            if value and value.HasConnectedSource():
                self._notes["textures are left out"] = None
            inputs[name] = np.array(value.Get() if value and value.Get() is not None else default, np.float64)
        shares = [float(LUMINANCE @ inputs["diffuseColor"]), float(inputs["metallic"]), float(inputs["roughness"])]
        return dict(zip(("luminance", "metallic", "roughness"), np.clip(shares, 0, 1).tolist(), strict=True))


def _node(name: str, parent: int, pose: _Pose) -> _Object:
    place, turn, scale = (values.tolist() for values in pose)
    return {"name": name, "parent": parent, "translation": place, "rotation": turn, "scale": scale}


def _sampled(transform: Any, name: str) -> tuple[_Array, list[_Pose]]:
    """Return time codes and poses that are close enough."""
    codes = np.array(transform.GetTimeSamples(), np.float64)
    codes = np.unique(np.concatenate([np.linspace(a, b, 9) for a, b in itertools.pairwise(codes)]))
    while True:
        half = (codes[:-1] + codes[1:]) / 2
        poses = [_pose(transform, code, name) for code in codes]
        between = [_pose(transform, code, name) for code in half]
        range_m = max(np.ptp([pose[0] for pose in poses], axis=0).max(), 1e-9)
        off = [
            max(
                np.abs((a[0] + b[0]) / 2 - exact[0]).max() / range_m,
                2 * np.linalg.norm(_middle(a[1], b[1]) - exact[1] * np.sign(_middle(a[1], b[1]) @ exact[1])),
            )
            for a, b, exact in zip(poses[:-1], poses[1:], between, strict=True)
        ]
        if max(off) <= _WITHIN:
            return codes, poses
        if 2 * len(codes) > _MOST_SAMPLES:
            raise SceneError(f"prim {name!r}: its motion cannot be followed: it jumps, or turns too fast")
        codes = np.sort(np.concatenate([codes, half]))


def _middle(a: _Array, b: _Array) -> _Array:
    total = a + b * (1.0 if a @ b >= 0 else -1.0)
    return np.asarray(total / np.linalg.norm(total))


def _pose(transform: Any, code: float, name: str) -> _Pose:
    matrix = np.array(transform.GetLocalTransformation(code)).T
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    at_start = np.linalg.norm(np.array(transform.GetLocalTransformation(transform.GetTimeSamples()[0]))[:3, :3], axis=1)
    if not np.isfinite(matrix).all() or not scale.min() > 0:
        raise SceneError(f"prim {name!r}: its transform is not finite, or flat")
    turn = matrix[:3, :3] / scale
    bent = np.abs(turn.T @ turn - np.eye(3)).max() > 1e-6 or np.linalg.det(turn) < 0
    if bent or np.abs(scale / at_start - 1).max() > 1e-6:
        raise SceneError(f"prim {name!r}: its scale moves, is mirrored or sheared: bodies are rigid")
    return matrix[:3, 3], quaternion_of(turn), scale
