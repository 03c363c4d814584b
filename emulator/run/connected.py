"""A rig whose Basilisk paths are flown by a simulation."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, TypeVar

from emulator.rig.loading import Rig, RigError
from emulator.trajectory.basilisk import ConnectedPath, flown_path
from emulator.trajectory.parameters import BasiliskPath
from firmware_protocol.vizard.update import CameraState

__all__ = ["camera_differs", "connected"]

T = TypeVar("T")

_FOCAL_WITHIN = 0.01


def connected(rig: Rig) -> tuple[Rig, tuple[ConnectedPath, ...]]:
    """Return the rig in step with a simulation, and what the simulation flies of it; raises RigError."""
    if rig.run.lockstep_us:
        raise RigError(f"{rig.name}: run.lockstep_us: the simulation drives this run, so no bus can")
    if getattr(rig.scene, "time_scale", 1.0) != 1.0:
        raise RigError(f"{rig.name}: scene.time_scale: it must be 1, because the simulation tells the time")
    paths: list[ConnectedPath] = []
    scene = _connected(rig.scene, paths)
    if not paths:
        raise RigError(f'{rig.name}: nothing here is flown by Basilisk: give a path with kind = "basilisk"')
    run = dataclasses.replace(rig.run, pace="free")
    return dataclasses.replace(rig, scene=scene, run=run), tuple(paths)


def camera_differs(rig: Rig, camera: CameraState) -> str:
    """Say how the rig's camera differs from Basilisk's in size or focal length; empty: it does not."""
    width, height = rig.camera.size
    own_px = width / 2 / math.tan(math.radians(rig.camera.lens.field_of_view_deg) / 2)
    theirs_px = _focal_px(camera)
    if camera.size == (width, height) and abs(theirs_px / own_px - 1) < _FOCAL_WITHIN:
        return ""
    return (
        f"Basilisk's camera has {camera.size[0]} x {camera.size[1]} pixels and a focal length of {theirs_px:.1f} "
        f"pixels, the rig's {width} x {height} and {own_px:.1f}"
    )


def _focal_px(camera: CameraState) -> float:
    half = math.radians(camera.field_of_view_deg) / 2
    return camera.size[1] / 2 / math.tan(half) if 0 < half < math.pi / 2 else math.nan


def _connected(value: T, paths: list[ConnectedPath]) -> T:
    """Return a table of a rig with all Basilisk paths in it connected; they are added to `paths`."""
    if isinstance(value, BasiliskPath):
        paths.append(ConnectedPath(**_fields(value), flown=flown_path(value)))
        return paths[-1]  # type: ignore[return-value]
    if isinstance(value, tuple):
        return tuple(_connected(one, paths) for one in value)  # type: ignore[return-value]
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    return dataclasses.replace(value, **{name: _connected(one, paths) for name, one in _fields(value).items()})


def _fields(value: Any) -> dict[str, Any]:
    return {field.name: getattr(value, field.name) for field in dataclasses.fields(value) if field.init}
