"""Records of a DVXplorer, and of a DVXplorer Micro with each of two versions of its device."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

from emulator.optics.lens import CHIPS
from emulator.rig.kinds import IMU_UNITS, CameraModel, UsbModel, UsbSettings
from emulator.rig.tables import Camera
from emulator.sensor.presets import PRESETS
from firmware_protocol.dvxplorer import Dvxplorer, DvxplorerMicro, DvxplorerMicroSettings, DvxplorerSettings
from firmware_protocol.dvxplorer.registers import SYSTEM
from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import UsbCamera


def _large(camera: Camera, usb: UsbSettings) -> Callable[[], UsbCamera]:
    settings = DvxplorerSettings(
        serial=camera.serial,
        speed=Speed[camera.speed.upper()],
        fifo_bytes=camera.fifo_bytes,
        start_delay_us=round(usb.start_delay_ms * 1000),
        system=dataclasses.replace(SYSTEM, timestamp_master=usb.is_master),
        imu_unit=0 if camera.imu is None else IMU_UNITS[camera.imu.unit],
        pulse_us=usb.pulse_us,
    )
    return partial(Dvxplorer, settings)


def _micro(bcd_device: int, camera: Camera, usb: UsbSettings) -> Callable[[], UsbCamera]:
    settings = DvxplorerMicroSettings(
        serial=camera.serial,
        bcd_device=bcd_device,
        speed=Speed[camera.speed.upper()],
        fifo_bytes=camera.fifo_bytes,
        start_delay_us=round(usb.start_delay_ms * 1000),
        imu_unit=0 if camera.imu is None else IMU_UNITS[camera.imu.unit],
    )
    return partial(DvxplorerMicro, settings)


def _model(name: str, device: Callable[[Camera, UsbSettings], Callable[[], UsbCamera]]) -> CameraModel:
    usb = UsbModel((640, 480), device, has_groups=True, imu_units=("bmi160",))
    return CameraModel(name, PRESETS["dvxplorer_micro"], CHIPS["dvxplorer_micro"], usb)


DVXPLORER = _model("dvxplorer", _large)
DVXPLORER_MICRO = _model("dvxplorer_micro", partial(_micro, 0x040A))
DVXPLORER_MICRO_FIRMWARE9 = _model("dvxplorer_micro_firmware9", partial(_micro, 0x0409))
