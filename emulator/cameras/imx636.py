"""Records of cameras with an IMX636: the EVK4 and its siblings, the Triton2, the sensor alone; and of a Gen 3.1."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from emulator.optics.lens import CHIPS
from emulator.rig.kinds import CameraModel, UsbModel, UsbSettings
from emulator.rig.tables import Camera
from emulator.sensor.presets import PRESETS
from firmware_protocol.imx636.boards import BOARDS
from firmware_protocol.imx636.evk4 import Evk4, Evk4Settings
from firmware_protocol.imx636.registers import Surroundings
from firmware_protocol.prophesee.biases import BiasSlopes
from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import UsbCamera


def _device(camera: Camera, usb: UsbSettings) -> Callable[[], UsbCamera]:
    sensor = camera.sensor
    settings = Evk4Settings(
        serial=camera.serial,
        speed=Speed[camera.speed.upper()],
        fifo_bytes=camera.fifo_bytes,
        start_delay_us=round(usb.start_delay_ms * 1000),
        surroundings=Surroundings(celsius=sensor.temperature.celsius, dead_time_us=sensor.refractory_us),
        biases=camera.bias_model,
        board=BOARDS[camera.model],
        pulse_us=usb.pulse_us,
    )
    return partial(Evk4, settings)


def _model(name: str, usb: UsbModel | None = None, *, gige: bool = False) -> CameraModel:
    return CameraModel(name, PRESETS["imx636"], CHIPS["imx636"], usb, gige, BiasSlopes())


_USB = UsbModel((1280, 720), _device, has_evt=True)

IMX636 = _model("imx636")
EVK4 = _model("evk4", _USB)
EVK3_HD = _model("evk3_hd", _USB)
SILKYEVCAM_HD = _model("silkyevcam_hd", _USB)
SILKYEVCAM_HD_LITE = _model("silkyevcam_hd_lite", _USB)
UEYE_XCP_E = _model("ueye_xcp_e", _USB)
UEYE_XLS_E = _model("ueye_xls_e", _USB)
TRITON2 = _model("triton2", gige=True)
GEN31 = CameraModel("gen31", PRESETS["gen31"], CHIPS["gen31"])
