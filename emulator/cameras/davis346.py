"""Records of a DAVIS346, of an ideal sensor with its USB device, and of a DAVIS240C."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

from emulator.optics.lens import Chip
from emulator.rig.kinds import IMU_UNITS, CameraKernels, CameraModel, UsbModel, UsbSettings
from emulator.rig.tables import Camera
from emulator.sensor.presets import PRESETS
from firmware_protocol.davis346.device import Davis240c, Davis240cSettings, Davis346, Davis346Settings
from firmware_protocol.davis346.model import DAVIS240C as _DAVIS240C
from firmware_protocol.davis346.registers import Layout
from firmware_protocol.fx3.registers import SystemInfo
from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import UsbCamera

_IMU_UNITS = ("mpu_9250", "mpu_6050")


def _device(camera: Camera, usb: UsbSettings) -> Callable[[], UsbCamera]:
    settings = Davis346Settings(
        **usb.of_device(camera),
        size=camera.size,
        layout=Layout[camera.layout.upper()],
        system=SystemInfo(timestamp_master=usb.is_master),
        imu_unit=IMU_UNITS[camera.imu.unit] if camera.imu is not None and camera.imu.unit in _IMU_UNITS else 0,
        frames=camera.frames is not None,
        activity_filter=camera.activity_filter,
    )
    return partial(Davis346, settings)


def _compile_activity_filter() -> None:
    """Make the filters of background activity and refractory period."""
    from firmware_protocol.davis346.activity_filter import ActivityFilter

    ActivityFilter((32, 24))


def _kernels(camera: Camera) -> tuple[CameraKernels, ...]:
    return (CameraKernels("activity filter", 1.0, _compile_activity_filter),) if camera.activity_filter else ()


_USB = UsbModel((346, 260), _device, kernels=_kernels, imu_units=_IMU_UNITS)


def _device_240c(camera: Camera, usb: UsbSettings) -> Callable[[], UsbCamera]:
    settings = Davis240cSettings(
        **(usb.of_device(camera) | {"speed": Speed.HIGH}),
        size=camera.size,
        layout=Layout[camera.layout.upper()],
        imu_unit=0 if camera.imu is None else IMU_UNITS[camera.imu.unit],
        frames=camera.frames is not None,
        activity_filter=camera.activity_filter,
    )
    system = dataclasses.replace(settings.system, timestamp_master=usb.is_master)
    return partial(Davis240c, dataclasses.replace(settings, system=system))


def _biases_240c(camera: Camera) -> Any:
    from firmware_protocol.instrument.settings import DavisBiases

    return DavisBiases(_DAVIS240C)


_CHIP = Chip(18.5, 0.22, 0.24)
"""Pitch of both chips as in their data sheets; fill factor as published for a DAVIS240; the efficiency of a
front-illuminated chip is an estimate."""

DAVIS346 = CameraModel("davis346", PRESETS["davis346"], _CHIP, _USB)
IDEAL = CameraModel("ideal", PRESETS["ideal"], _CHIP, _USB)
DAVIS240C = CameraModel(
    "davis240c",
    PRESETS["davis240c"],
    _CHIP,
    UsbModel(_DAVIS240C.size, _device_240c, imu_units=("mpu_6050",)),
    commanded_biases=_biases_240c,
)
