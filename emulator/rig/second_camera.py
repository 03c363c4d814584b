"""The rig of a run's second camera: its model, its links, and the scene from where it is mounted."""

from __future__ import annotations

import dataclasses

from emulator.rig.kinds import CAMERA_MODELS
from emulator.rig.loading import Rig, RigError
from emulator.rig.tables import Camera, SecondCamera
from emulator.scene.kind import SceneParameters


def carries_second(rig: Rig, link: str) -> bool:
    """Return whether a link carries the rig's second camera."""
    return rig.second_camera is not None and link in rig.second_camera.links


def second_rig(rig: Rig) -> Rig:
    """Return the rig as its second camera has it; raises RigError where its scene has no path to mount it on."""
    second = rig.second_camera
    assert second is not None
    seed = rig.run.seed + 1
    links = tuple(link for link in rig.links if carries_second(rig, link.name))
    run = dataclasses.replace(rig.run, seed=seed)
    return dataclasses.replace(
        rig,
        camera=_second_model(rig.camera, second),
        links=links,
        run=run,
        scene=_moved(rig, second),
        trigger=None,
        second_camera=None,
    )


def _second_model(first: Camera, second: SecondCamera) -> Camera:
    """Return the first camera with another serial number, or one of another model with the same lens and connector."""
    if second.model in ("", first.model):
        return dataclasses.replace(first, serial=second.serial)
    return dataclasses.replace(
        first,
        model=second.model,
        serial=second.serial,
        sensor=CAMERA_MODELS[second.model].sensor,
        imu=None,
        frames=None,
        bias_slopes=None,
        activity_filter=False,
    )


def _moved(rig: Rig, second: SecondCamera) -> SceneParameters:
    from emulator.trajectory.building import MountedPath
    from emulator.trajectory.parameters import BasiliskPath, LivePath

    path = getattr(rig.scene, "camera", None)
    if path is None or isinstance(path, LivePath | BasiliskPath):
        raise RigError(
            f"{rig.name}: second_camera: this scene's camera has no path of its own on which another can be mounted; "
            "take one of bodies, terrain or stars with a path that the rig gives"
        )
    moved = MountedPath(path, second.offset_m, second.q_first_from_second)
    return dataclasses.replace(rig.scene, camera=moved)
