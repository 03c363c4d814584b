"""Records of a DAVIS346, and of an ideal sensor with its USB device."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from emulator.optics.lens import Chip
from emulator.rig.kinds import IMU_UNITS, CameraKernels, CameraModel, UsbModel, UsbSettings
from emulator.rig.tables import Camera
from emulator.sensor.presets import PRESETS
from firmware_protocol.davis346 import Davis346, Davis346Settings, Layout
from firmware_protocol.fx3.registers import SystemInfo
from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import UsbCamera

_IMU_UNITS = ("mpu_9250", "mpu_6050")


def _device(camera: Camera, usb: UsbSettings) -> Callable[[], UsbCamera]:
    settings = Davis346Settings(
        serial=camera.serial,
        size=camera.size,
        speed=Speed[camera.speed.upper()],
        layout=Layout[camera.layout.upper()],
        fifo_bytes=camera.fifo_bytes,
        start_delay_us=round(usb.start_delay_ms * 1000),
        system=SystemInfo(timestamp_master=usb.is_master),
        imu_unit=IMU_UNITS[camera.imu.unit] if camera.imu is not None and camera.imu.unit in _IMU_UNITS else 0,
        frames=camera.frames is not None,
        activity_filter=camera.activity_filter,
        pulse_us=usb.pulse_us,
    )
    return partial(Davis346, settings)


def _compile_activity_filter() -> None:
    """Make the filters of background activity and refractory period."""
    from firmware_protocol.davis346.activity_filter import ActivityFilter

    ActivityFilter((32, 24))


def _kernels(camera: Camera) -> tuple[CameraKernels, ...]:
    return (CameraKernels("activity filter", 1.0, _compile_activity_filter),) if camera.activity_filter else ()


_USB = UsbModel((346, 260), _device, kernels=_kernels, imu_units=_IMU_UNITS)
_CHIP = Chip(18.5, 0.22, 0.24)
"""Pitch as in its data sheet; fill factor and efficiency of a front-illuminated chip are estimates."""

DAVIS346 = CameraModel("davis346", PRESETS["davis346"], _CHIP, _USB)
IDEAL = CameraModel("ideal", PRESETS["ideal"], _CHIP, _USB)
