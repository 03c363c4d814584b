"""Records of cameras with an IMX636: the EVK4 and its siblings, the Triton2, the sensor alone."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from emulator.optics.lens import Chip
from emulator.rig.kinds import CameraModel, UsbModel, UsbSettings
from emulator.rig.tables import Camera
from emulator.sensor.presets import PRESETS
from firmware_protocol.device.event_device import EventDevice
from firmware_protocol.imx636.evk4 import BOARDS, Evk4, Evk4Settings
from firmware_protocol.imx636.registers import Surroundings
from firmware_protocol.prophesee.biases import BiasSlopes
from firmware_protocol.usb.device import UsbCamera


def _device(camera: Camera, usb: UsbSettings) -> Callable[[], UsbCamera]:
    sensor = camera.sensor
    settings = Evk4Settings(
        **usb.of_device(camera),
        surroundings=Surroundings(celsius=sensor.temperature.celsius, dead_time_us=sensor.refractory_us),
        biases=camera.bias_model,
        board=BOARDS[camera.model],
    )
    return partial(Evk4, settings)


def _gige_device(camera: Camera, link: Any, pulse_us: int) -> Callable[[], EventDevice]:
    from firmware_protocol.imx636.triton2 import Triton2
    from firmware_protocol.imx636.triton2_registers import Triton2Settings

    settings = Triton2Settings(
        size=camera.size,
        address=link.host,
        serial=camera.serial,
        start_delay_us=round(camera.start_delay_ms * 1000),
        block_us=link.block_us,
        reserved_words=link.reserved_words,
        biases=camera.bias_model,
        ptp=link.ptp,
        ptp_domain=link.ptp_domain,
        pulse_us=pulse_us,
    )
    return partial(Triton2, settings)


def _commanded_biases(camera: Camera) -> Any:
    from firmware_protocol.instrument.settings import Imx636Biases

    return Imx636Biases(camera.bias_model)


_model = partial(
    CameraModel,
    sensor=PRESETS["imx636"],
    chip=Chip(4.86, 0.77, 0.7),  # estimates for a back-illuminated chip
    bias_slopes=BiasSlopes(),
    commanded_biases=_commanded_biases,
)
_USB = UsbModel((1280, 720), _device, has_evt=True)

IMX636 = _model("imx636")
EVK4 = _model("evk4", usb=_USB)
EVK3_HD = _model("evk3_hd", usb=_USB)
SILKYEVCAM_HD = _model("silkyevcam_hd", usb=_USB)
SILKYEVCAM_HD_LITE = _model("silkyevcam_hd_lite", usb=_USB)
UEYE_XCP_E = _model("ueye_xcp_e", usb=_USB)
UEYE_XLS_E = _model("ueye_xls_e", usb=_USB)
TRITON2 = _model("triton2", gige=_gige_device)
