"""From a rig to its inertial unit: the path that carries it, and the gravity along it."""

from __future__ import annotations

import dataclasses

import numpy as np

from emulator.light import Scene
from emulator.optics.through import Through
from emulator.rig.loading import Rig
from emulator.scene.terrain.table import TerrainParameters
from emulator.sensor.imu.gravity import EARTH_IN_THE_PICTURE, MOON_BELOW, WEIGHTLESS, Gravity
from emulator.sensor.imu.parameters import ImuParameters
from emulator.sensor.imu.source import ImuSource
from emulator.sensor.imu.unit import Carried, ImuUnit
from emulator.trajectory.camera_path import HasCameraPath
from emulator.trajectory.parameters import OrbitPath
from emulator.trajectory.pose import Fixed
from emulator.trajectory.timescale import Timescale

__all__ = ["carried", "imu_source"]


def imu_source(rig: Rig, scene: Scene) -> ImuSource | None:
    """Return what samples the rig's inertial unit on the path of the scene's camera; None where it has none."""
    imu = rig.camera.imu
    return None if imu is None else ImuSource(ImuUnit(imu, carried(rig, imu, scene), rig.run.seed))


def carried(rig: Rig, imu: ImuParameters, scene: Scene) -> Carried:
    """Return path, gravity and time of the unit; on a bench where the scene's camera has no path."""
    inner = scene.scene if isinstance(scene, Through) else scene
    given = Gravity(np.zeros(3) if imu.gravity_m_s2 is None else np.array(imu.gravity_m_s2), imu.gm_m3_s2)
    is_given = imu.gravity_m_s2 is not None or imu.gm_m3_s2 > 0
    if not isinstance(inner, HasCameraPath):
        return Carried(Fixed(), given if is_given else EARTH_IN_THE_PICTURE, Timescale())
    return Carried(inner.camera_path, given if is_given else _gravity_of(rig), inner.path_time)


def _gravity_of(rig: Rig) -> Gravity:
    """Return the gravity that the scene implies."""
    if isinstance(rig.scene, TerrainParameters):
        return MOON_BELOW
    path = getattr(rig.scene, "camera", None)
    return dataclasses.replace(WEIGHTLESS, gm_m3_s2=path.gm_m3_s2) if isinstance(path, OrbitPath) else WEIGHTLESS
