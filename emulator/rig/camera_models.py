"""The record of each camera model: its sensor, its chip, and its USB device where there is one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from emulator.optics.lens import CHIPS, Chip
from emulator.rig.tables import Camera
from emulator.sensor.presets import PRESETS, SensorParameters
from firmware_protocol.davis346 import Davis346, Davis346Settings, Layout, SystemInfo
from firmware_protocol.imx636.evk4 import Evk4, Evk4Settings
from firmware_protocol.imx636.registers import Surroundings
from firmware_protocol.usb.device import Speed, UsbCamera

__all__ = ["CAMERA_MODELS", "IMU_UNITS", "CameraModel", "UsbModel", "UsbSettings", "gige_models", "usb_sizes"]


@dataclass(frozen=True)
class UsbSettings:
    """Settings of a run for a camera's USB device; `pulse_us` None: no trigger is connected.

    `is_master` False: its clock follows that of another camera.
    """

    start_delay_ms: float
    pulse_us: int | None = None
    is_master: bool = True


@dataclass(frozen=True)
class UsbModel:
    """The USB device of a camera model.

    Attributes
    ----------
    size
        (width, height) of the real camera, pixels.
    device
        Returns the factory of the device in a link's process, which can be pickled; raises ValueError for a camera
        that the device cannot represent.
    has_evt
        Whether it sends EVT3 words: a run compiles their kernels before it begins.
    """

    size: tuple[int, int]
    device: Callable[[Camera, UsbSettings], Callable[[], UsbCamera]]
    has_evt: bool = False


@dataclass(frozen=True)
class CameraModel:
    """A camera model; `usb` None: there is no USB device for it yet.

    Attributes
    ----------
    gige
        Whether it is a GigE Vision device.
    """

    sensor: SensorParameters
    chip: Chip
    usb: UsbModel | None = None
    gige: bool = False

    @property
    def is_imx636(self) -> bool:
        """True for an IMX636: biases act by `camera.bias_slopes`."""
        return self.chip is CHIPS["imx636"]


IMU_UNITS = {"mpu_6050": 1, "mpu_9250": 2}
"""Register TYPE of an inertial unit."""


def _davis346(camera: Camera, usb: UsbSettings) -> Callable[[], UsbCamera]:
    settings = Davis346Settings(
        serial=camera.serial,
        size=camera.size,
        speed=Speed[camera.speed.upper()],
        layout=Layout[camera.layout.upper()],
        fifo_bytes=camera.fifo_bytes,
        start_delay_us=round(usb.start_delay_ms * 1000),
        system=SystemInfo(timestamp_master=usb.is_master),
        imu_unit=0 if camera.imu is None else IMU_UNITS[camera.imu.unit],
        frames=camera.frames is not None,
        activity_filter=camera.activity_filter,
        pulse_us=Davis346Settings.pulse_us if usb.pulse_us is None else usb.pulse_us,
    )
    return partial(Davis346, settings)


def _evk4(camera: Camera, usb: UsbSettings) -> Callable[[], UsbCamera]:
    sensor = camera.sensor
    settings = Evk4Settings(
        serial=camera.serial,
        speed=Speed[camera.speed.upper()],
        fifo_bytes=camera.fifo_bytes,
        start_delay_us=round(usb.start_delay_ms * 1000),
        surroundings=Surroundings(celsius=sensor.temperature.celsius, dead_time_us=sensor.refractory_us),
        biases=camera.bias_model,
    )
    return partial(Evk4, settings)


CAMERA_MODELS: Mapping[str, CameraModel] = {
    "davis346": CameraModel(PRESETS["davis346"], CHIPS["davis346"], UsbModel((346, 260), _davis346)),
    "dvxplorer_micro": CameraModel(PRESETS["dvxplorer_micro"], CHIPS["dvxplorer_micro"]),
    "imx636": CameraModel(PRESETS["imx636"], CHIPS["imx636"]),
    "evk4": CameraModel(PRESETS["imx636"], CHIPS["imx636"], UsbModel((1280, 720), _evk4, has_evt=True)),
    "triton2": CameraModel(PRESETS["imx636"], CHIPS["imx636"], gige=True),
    "ideal": CameraModel(PRESETS["ideal"], CHIPS["davis346"], UsbModel((346, 260), _davis346)),
}
"""Camera models by the name that rigs write."""


def gige_models() -> tuple[str, ...]:
    """Return the camera models that have a GigE Vision device."""
    return tuple(name for name, model in CAMERA_MODELS.items() if model.gige)


def usb_sizes() -> dict[str, tuple[int, int]]:
    """Return the size of each camera model that has a USB device."""
    return {name: model.usb.size for name, model in CAMERA_MODELS.items() if model.usb is not None}
