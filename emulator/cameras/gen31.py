"""Records of cameras with a Gen 3.1: a SilkyEvCam VGA, an EVK3 VGA, the sensor alone."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from emulator.optics.lens import Chip
from emulator.rig.kinds import CameraModel, UsbModel, UsbSettings
from emulator.rig.tables import Camera
from emulator.sensor.presets import PRESETS
from firmware_protocol.gen31.device import BOARDS, SLOPES, Gen31, Gen31Settings
from firmware_protocol.usb.device import UsbCamera


def _device(camera: Camera, usb: UsbSettings) -> Callable[[], UsbCamera]:
    settings = Gen31Settings(
        **usb.of_device(camera),
        celsius=camera.sensor.temperature.celsius,
        biases=camera.bias_model,
        board=BOARDS[camera.model],
    )
    return partial(Gen31, settings)


_model = partial(
    CameraModel,
    sensor=PRESETS["gen31"],
    chip=Chip(15.0, 0.25, 0.3),  # pitch and fill factor as in `sensor.presets`; the efficiency is an estimate
    bias_slopes=SLOPES,
)
_USB = UsbModel((640, 480), _device, has_evt=True)

GEN31 = _model("gen31")
SILKYEVCAM_VGA = _model("silkyevcam_vga", usb=_USB)
EVK3_VGA = _model("evk3_vga", usb=_USB)
