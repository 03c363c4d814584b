"""The kinds of links, scenes and cameras that a rig can name, and the assignment of faults to its links.

A registry has the built-in kinds, and those of installed packages (groups "evstim.links", "evstim.scenes" and
"evstim.cameras"). A fault is converted from a table of a rig, or of `evstim fault`. A camera model has one record: its
sensor, its chip, and its USB device where there is one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from emulator.optics.lens import Chip
from emulator.rig.tables import Camera
from emulator.scene.kind import SceneKind
from emulator.sensor.presets import SensorParameters
from emulator.tables.toml_text import KeyPath
from emulator.tables.typed_table import TableError, convert_kind
from firmware_protocol.device.event_device import EventDevice
from firmware_protocol.imu_samples import BMI160
from firmware_protocol.prophesee.biases import BiasSlopes
from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import UsbCamera
from transports.faults.kinds import FAULTS, Fault
from transports.link.kind import LinkKind, LinkParameters, possible_faults
from transports.registry import PluginError, Registry, unknown

LINKS: Registry[LinkKind[Any]] = Registry(
    "evstim.links",
    LinkKind,
    {
        "usbip": "transports.usb.kind:USBIP",
        "usb_gadget": "transports.usb.kind:USB_GADGET",
        "loopback": "transports.usb.kind:LOOPBACK",
        "serial": "transports.serial_line.kind:SERIAL",
        "gige": "transports.gige.kind:GIGE",
        "file": "transports.file:FILE",
        "tcp": "transports.network_streams.kind:TCP",
        "udp": "transports.network_streams.kind:UDP",
        "udp_packets": "transports.udp_packets.kind:UDP_PACKETS",
        "ros2": "transports.ros2.kind:ROS2",
        "can": "transports.can_bus.kind:CAN",
    },
)
"""Kinds of links by the name that rigs write."""

SCENES: Registry[SceneKind] = Registry(
    "evstim.scenes",
    SceneKind,
    {
        "checkerboard": "emulator.scene.checkerboard.table:CHECKERBOARD",
        "bodies": "emulator.scene.bodies.table:BODIES",
        "terrain": "emulator.scene.terrain.table:TERRAIN",
        "stars": "emulator.scene.stars.table:STARS",
        "video": "emulator.scene.video.video:VIDEO",
        "ros2": "emulator.scene.video.ros2_images:ROS2_IMAGES",
        "external": "emulator.scene.external.table:EXTERNAL",
        "recording": "emulator.playback.recording:RECORDING",
    },
)
"""Kinds of scenes by the name that rigs write."""


def faults_of(link: LinkParameters) -> Mapping[str, type[Fault]]:
    """Return the faults that a link of these parameters can have, by kind."""
    return possible_faults(LINKS[link.kind], link)


def convert_fault(table: object, links: Sequence[LinkParameters], path: KeyPath) -> Fault:
    """Return a table as a fault of one of `links`, whose name it then has; raises TableError."""
    try:
        fault = convert_kind(table, FAULTS, path)
    except PluginError as error:
        raise TableError(str(error), (*path, "kind")) from error
    return assigned_fault(fault, links, path)


def assigned_fault(fault: Fault, links: Sequence[LinkParameters], path: KeyPath = ()) -> Fault:
    """Return a fault with the name of the link of `links` that has it; raises TableError, at `path`."""
    able = [link.name for link in links if fault.kind in faults_of(link)]
    if not fault.link and len(able) == 1:
        return dataclasses.replace(fault, link=able[0])
    if fault.link in able:
        return fault
    if not able:
        raise TableError(f"no link of this rig can have a fault of kind {fault.kind!r}", (*path, "kind"))
    if not fault.link:
        raise TableError(f"'link' is missing: {', '.join(able)} can all have {fault.kind!r}", (*path, "kind"))
    if fault.link not in [link.name for link in links]:
        raise TableError(unknown(fault.link, [link.name for link in links]), (*path, "link"))
    raise TableError(
        f"link {fault.link!r} cannot have a fault of kind {fault.kind!r}; {', '.join(able)} can", (*path, "link")
    )


@dataclass(frozen=True)
class UsbSettings:
    """Settings of a run for a camera's USB device; `is_master` False: its clock follows that of another camera."""

    start_delay_ms: float
    pulse_us: int = 100
    is_master: bool = True

    def of_device(self, camera: Camera) -> dict[str, Any]:
        """Return what settings of all devices have alike, by their names there."""
        speed, delay_us = Speed[camera.speed.upper()], round(self.start_delay_ms * 1000)
        common = {"serial": camera.serial, "speed": speed, "fifo_bytes": camera.fifo_bytes}
        return {**common, "start_delay_us": delay_us, "pulse_us": self.pulse_us}


class CameraKernels(NamedTuple):
    """Kernels of a camera: their name for people, the time to compile them, and the function that does it."""

    name: str
    seconds: float
    compile: Callable[[], None]


@dataclass(frozen=True)
class UsbModel:
    """The USB device of a camera model.

    Attributes
    ----------
    size : (width, height) of the real camera, pixels.
    device : returns the factory of the device in a link's process, which can be pickled; raises ValueError for a camera
        that the device cannot represent.
    has_evt : whether it sends EVT words: a run compiles their kernels before it begins.
    kernels : returns the kernels of its own that a camera uses, which a run compiles likewise.
    imu_units : inertial units that it can have; None: it has no use for one, and any is allowed.
    """

    size: tuple[int, int]
    device: Callable[[Camera, UsbSettings], Callable[[], UsbCamera]]
    has_evt: bool = False
    kernels: Callable[[Camera], tuple[CameraKernels, ...]] = lambda camera: ()
    imu_units: tuple[str, ...] | None = None


@dataclass(frozen=True)
class CameraModel:
    """A camera model; `usb` None: there is no USB device for it yet.

    Attributes
    ----------
    name : name of the model, the value of `camera.model` in rigs.
    gige : returns the factory of its GigE Vision device for a camera, the parameters of the link, and the length of a
        pulse on its input, us; None: it is no such device.
    bias_slopes : effects of its biases where a rig gives none, if `camera.bias_slopes` may change them.
    commanded_biases : returns the biases that telecommands of an instrument change; None: those of its own sensor.
    """

    name: str
    sensor: SensorParameters
    chip: Chip
    usb: UsbModel | None = None
    gige: Callable[[Camera, Any, int], Callable[[], EventDevice]] | None = None
    bias_slopes: BiasSlopes | None = None
    commanded_biases: Callable[[Camera], Any] | None = None


CAMERA_MODELS: Registry[CameraModel] = Registry(
    "evstim.cameras",
    CameraModel,
    {
        name: f"emulator.cameras.{module}:{name.upper()}"
        for module, names in (
            ("davis346", ("davis346", "davis240c")),
            ("dvxplorer", ("dvxplorer", "dvxplorer_micro", "dvxplorer_micro_firmware9")),
            ("imx636", ("imx636", "evk4", "evk3_hd", "silkyevcam_hd", "silkyevcam_hd_lite")),
            ("imx636", ("ueye_xcp_e", "ueye_xls_e", "triton2")),
            ("gen31", ("gen31", "silkyevcam_vga", "evk3_vga")),
            ("genx320", ("genx320",)),
            ("davis346", ("ideal",)),
        )
        for name in names
    },
)
"""Camera models by the name that rigs write."""


IMU_UNITS = {"mpu_6050": 1, "mpu_9250": 2, "bmi160": BMI160}
"""Register TYPE of an inertial unit."""


IMU_DRIVERS = {
    1: "firmware_protocol.davis346.registers:driver_imu_settings",
    2: "firmware_protocol.davis346.registers:driver_imu_settings",
    BMI160: "firmware_protocol.dvxplorer.registers:driver_imu_settings",
}
"""Import path of the function that returns the settings which drivers write to a unit, by its TYPE."""


def usb_model(camera: Camera, kind: LinkKind[Any]) -> UsbModel | None:
    """Return the USB device of a camera on a link of a kind; None if there is none.

    A link may carry a camera without a USB device of its size in the words of another model.
    """
    usb = CAMERA_MODELS[camera.model].usb
    if kind.usb_model is None or (usb is not None and usb.size == camera.size):
        return usb
    return CAMERA_MODELS[kind.usb_model].usb


def gige_models() -> tuple[str, ...]:
    """Return the camera models that have a GigE Vision device."""
    return tuple(name for name, model in CAMERA_MODELS.usable().items() if model.gige is not None)


def usb_sizes() -> dict[str, tuple[int, int]]:
    """Return the size of each camera model that has a USB device."""
    return {name: model.usb.size for name, model in CAMERA_MODELS.usable().items() if model.usb is not None}
