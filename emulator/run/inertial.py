"""Inertial unit of a rig's camera: the path that carries it, the gravity along this path, and its initial settings."""

from __future__ import annotations

import dataclasses

import numpy as np

from emulator.light import Scene
from emulator.optics.glare import Veiled
from emulator.optics.through import Through
from emulator.rig.kinds import IMU_DRIVERS, IMU_UNITS
from emulator.rig.loading import Rig
from emulator.scene.terrain.table import TerrainParameters
from emulator.sensor.imu import EARTH_IN_THE_PICTURE, MOON_BELOW, WEIGHTLESS, Carried, Gravity, ImuSource, ImuUnit
from emulator.sensor.parameters import ImuParameters
from emulator.trajectory.building import HasCameraPath
from emulator.trajectory.parameters import OrbitPath
from emulator.trajectory.pose import Fixed, Timescale
from firmware_protocol.imu_samples import ImuSettings
from transports.registry import imported


def imu_source(rig: Rig, imu: ImuParameters, scene: Scene) -> ImuSource:
    """Return the source of inertial samples on the path of the scene's camera."""
    return ImuSource(ImuUnit(imu, carried(rig, imu, scene), rig.run.seed))


def carried(rig: Rig, imu: ImuParameters, scene: Scene) -> Carried:
    """Return path, gravity and time of the unit; on a bench where the scene's camera has no path."""
    inner = scene
    while isinstance(inner, Through | Veiled):
        inner = inner.scene
    gravity = Gravity(np.zeros(3) if imu.gravity_m_s2 is None else np.array(imu.gravity_m_s2), imu.gm_m3_s2)
    is_given = imu.gravity_m_s2 is not None or imu.gm_m3_s2 > 0
    if not isinstance(inner, HasCameraPath):
        return Carried(Fixed(), gravity if is_given else EARTH_IN_THE_PICTURE, Timescale())
    return Carried(inner.camera_path, gravity if is_given else _gravity_of(rig), inner.path_time)


def _gravity_of(rig: Rig) -> Gravity:
    """Return the gravity that the scene implies."""
    if isinstance(rig.scene, TerrainParameters):
        return MOON_BELOW
    path = getattr(rig.scene, "camera", None)
    return dataclasses.replace(WEIGHTLESS, gm_m3_s2=path.gm_m3_s2) if isinstance(path, OrbitPath) else WEIGHTLESS


def host_imu_settings(unit: str) -> ImuSettings:
    """Return the settings that the drivers of a unit's cameras write by default."""
    number = IMU_UNITS[unit]
    settings: ImuSettings = imported(IMU_DRIVERS[number])(number)
    return settings
