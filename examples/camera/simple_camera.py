"""A camera for USB, complete: its record for rigs, its descriptors, one request, and the bytes of its events.

Vendor request 1 (OUT) starts the events with wValue 1 and stops them with 0. They leave at bulk endpoint 0x81, 8 bytes
each, little-endian: u32 device time in us, u16 x, u16 y with bit 15 for ON.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from emulator.optics.lens import Chip
from emulator.rig.kinds import CameraModel, UsbModel, UsbSettings
from emulator.rig.tables import Camera
from emulator.sensor.presets import ReadoutParameters, SensorParameters
from firmware_protocol.device.plain_device import PlainDevice, own_time
from firmware_protocol.usb import descriptors as usb
from firmware_protocol.usb.control import StandardControl
from firmware_protocol.usb.device import (
    Identity,
    RequestKind,
    SetupPacket,
    Stall,
    Transfer,
    UsbCamera,
    UsbCameraSettings,
)

WORD = np.dtype([("t", "<u4"), ("x", "<u2"), ("y_on", "<u2")])
IDS = 0x1209, 0x0001  # vendor and product: pid.codes gives the pair away for tests


@dataclass(frozen=True)
class Settings(UsbCameraSettings):
    @property
    def identity(self) -> Identity:
        return Identity(*IDS, self.bcd_device, self.speed)

    def descriptors(self) -> usb.DescriptorSet:
        endpoint = usb.Endpoint(0x81, usb.TransferType.BULK, usb.BULK_PACKET[self.speed])
        return usb.DescriptorSet(
            usb.DeviceDescriptor(self.speed, *IDS, self.bcd_device),
            usb.Configuration(self.speed, (usb.Interface((endpoint,)),)),
            strings={1: "Example", 2: "Simple camera", 3: self.serial},
        )


class SimpleCamera(PlainDevice, UsbCamera):
    data_endpoint = 1

    def __init__(self, settings: Settings) -> None:
        super().__init__(capacity=settings.fifo_bytes // WORD.itemsize)
        self.settings = settings
        self.takes_edges = False  # it has no external input
        self._control = StandardControl(settings.descriptors())
        self._power_on()

    def _power_on(self) -> None:
        self.run(False)
        self._control.power_on()

    def control(self, setup: SetupPacket, data: bytes) -> bytes:
        if setup.kind is not RequestKind.VENDOR:
            return self._control.control(setup, data)
        if setup.is_in or setup.request != 1:
            raise Stall(f"{setup} is unknown")
        self.run(bool(setup.value))
        return b""

    def read(self, endpoint: int, max_bytes: int) -> Transfer | None:
        self._control.require(0x80 | endpoint)
        items = self.take(max_bytes // WORD.itemsize)
        if items is None:
            return None
        events = own_time(items.events, items.epoch_us)
        words = np.empty(len(events), WORD)
        words["t"], words["x"] = events["t"], events["x"]
        words["y_on"] = events["y"] | events["on"].astype("<u2") << 15
        return Transfer(items.events, items.edges, items.epoch_us, data=words.tobytes())


def _device(camera: Camera, usb_settings: UsbSettings) -> Callable[[], SimpleCamera]:
    speed = usb.Speed[camera.speed.upper()]
    return partial(SimpleCamera, Settings(camera.serial, speed=speed, fifo_bytes=camera.fifo_bytes))


SIMPLE_CAMERA = CameraModel(
    "simple_camera",
    SensorParameters(160, 120, threshold_on=0.25, threshold_off=0.25, readout=ReadoutParameters(100.0, row_ns=0)),
    Chip(pitch_um=15.0, fill_factor=0.25, quantum_efficiency=0.3),
    UsbModel((160, 120), _device),
)
