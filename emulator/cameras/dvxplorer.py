"""Records of a DVXplorer, and of a DVXplorer Micro with each of two versions of its device."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

from emulator.optics.lens import Chip
from emulator.rig.kinds import IMU_UNITS, CameraKernels, CameraModel, UsbModel, UsbSettings
from emulator.rig.tables import Camera
from emulator.sensor.presets import PRESETS
from firmware_protocol.dvxplorer.decoder import GroupDecoder
from firmware_protocol.dvxplorer.device import Dvxplorer, DvxplorerSettings
from firmware_protocol.dvxplorer.frame_words import FrameDecoder
from firmware_protocol.dvxplorer.micro import DvxplorerMicro, DvxplorerMicroSettings
from firmware_protocol.dvxplorer.registers import SYSTEM
from firmware_protocol.dvxplorer.words import GroupEncoder
from firmware_protocol.usb.device import UsbCamera


def _large(camera: Camera, usb: UsbSettings) -> Callable[[], UsbCamera]:
    settings = DvxplorerSettings(
        **usb.of_device(camera),
        system=dataclasses.replace(SYSTEM, timestamp_master=usb.is_master),
        imu_unit=0 if camera.imu is None else IMU_UNITS[camera.imu.unit],
    )
    return partial(Dvxplorer, settings)


def _micro(bcd_device: int, camera: Camera, usb: UsbSettings) -> Callable[[], UsbCamera]:
    settings = DvxplorerMicroSettings(
        **usb.of_device(camera),
        bcd_device=bcd_device,
        imu_unit=0 if camera.imu is None else IMU_UNITS[camera.imu.unit],
    )
    return partial(DvxplorerMicro, settings)


def _compile_coders() -> None:
    """Make the coders and the decoders of both cameras' words."""
    GroupEncoder((32, 24)), GroupDecoder(), DvxplorerMicro(), FrameDecoder()


_KERNELS = (CameraKernels("DVXplorer coder", 3.0, _compile_coders),)
_CHIP = Chip(9.0, 0.22, 0.24)
"""Estimates, as for a DAVIS346."""


def _model(name: str, device: Callable[[Camera, UsbSettings], Callable[[], UsbCamera]]) -> CameraModel:
    usb = UsbModel((640, 480), device, kernels=lambda camera: _KERNELS, imu_units=("bmi160",))
    return CameraModel(name, PRESETS["dvxplorer_micro"], _CHIP, usb)


DVXPLORER = _model("dvxplorer", _large)
DVXPLORER_MICRO = _model("dvxplorer_micro", partial(_micro, 0x040A))
DVXPLORER_MICRO_FIRMWARE9 = _model("dvxplorer_micro_firmware9", partial(_micro, 0x0409))
