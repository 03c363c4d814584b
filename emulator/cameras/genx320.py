"""Record of a GenX320."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from emulator.optics.lens import Chip
from emulator.rig.kinds import CameraModel, UsbModel, UsbSettings
from emulator.rig.tables import Camera
from emulator.sensor.presets import PRESETS
from firmware_protocol.genx320.device import SLOPES, Genx320, Genx320Settings
from firmware_protocol.genx320.registers import Surroundings
from firmware_protocol.usb.device import UsbCamera


def _device(camera: Camera, usb: UsbSettings) -> Callable[[], UsbCamera]:
    sensor = camera.sensor
    settings = Genx320Settings(
        **usb.of_device(camera),
        surroundings=Surroundings(sensor.temperature.celsius, dead_time_us=sensor.refractory_us),
        biases=camera.bias_model,
    )
    return partial(Genx320, settings)


_CHIP = Chip(6.3, 0.77, 0.7)
"""Pitch as in `sensor.presets`; the others are estimates for a back-illuminated chip."""

GENX320 = CameraModel(
    "genx320", PRESETS["genx320"], _CHIP, UsbModel((320, 320), _device, has_evt=True), bias_slopes=SLOPES
)
