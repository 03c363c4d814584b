"""Settings of iniVation's cameras with an FX3: USB identity, array and sizes, and the USB descriptors.

Sources: USB identity from libcaer 3.3.15 and three drivers' checks; endpoints from the published FX3 firmware.

The model allows for two faults of drivers.

**neuromorphic_drivers loses the order of buffers if data flow at once.** Versions 0.16 to 0.18 start the sensor, then
submit 32 bulk transfers one after another, resubmit each as soon as it finishes, and take completions in ring order. If
a transfer finishes while the others are still being submitted, buffers are swapped or lost: 6 of 16 openings lost or
reordered events of a 50 000-event stream in a slow guest; with data held back for 0.3 s, 16 of 16 were exact. A real
camera has the same race, but its events are not compared with a reference. So the model sends nothing for
`start_delay_us` of stream time after the run gate opens, and again when the DVS is switched on, unless the host has
read by then: in the middle of a stream the DVS can be switched off and on without a silence. A timestamp reset ends the
silence at once: neuromorphic_drivers never sends one, and the drivers that do (libcaer, dv-processing) have queued all
their transfers by then; dv-processing waits 5 s for the reset.

**neuromorphic_drivers ignores the number of steps in a wrap word** and always adds 32 768 us (0.18.2). The encoder
sends wraps one by one, and uses words of many steps only when the host has not read for so long that single ones do
not fit. libcaer and dv-processing then keep the right time; neuromorphic_drivers falls behind, as it would with a real
camera.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

from firmware_protocol.fx3.registers import Register, SystemInfo
from firmware_protocol.usb.descriptors import (
    BULK_PACKET,
    OTHER_SPEED,
    Configuration,
    DescriptorSet,
    DeviceDescriptor,
    Endpoint,
    Interface,
    Speed,
    TransferType,
)
from firmware_protocol.usb.device import Identity, UsbCameraSettings

VENDOR_ID = 0x152A
DEBUG_ENDPOINT = 0x81
DATA_ENDPOINT = 0x82

_DEBUG_INTERVAL = {Speed.SUPER: 4, Speed.HIGH: 4, Speed.FULL: 1}


@dataclass(frozen=True)
class Fx3Settings(UsbCameraSettings):
    """Settings that iniVation's cameras with an FX3 share.

    Attributes
    ----------
    serial
        1 to 8 ASCII characters; libcaer and dv-processing cut longer ones.
    fifo_bytes
        Room for words that wait for the host. 256 KiB is the most that the FX3 can give to DMA buffers: its memory from
        0x40040000 to 0x40080000 in the vendor's memory map (cyfxtx.c). At 12 Mev/s of a DAVIS that lasts 4 to 10 ms.
    pulse_us
        Length of a pulse on the external input (an EDGE of kind PULSE).
    imu_unit
        Its inertial unit, by the numbers of `imu_samples`; 0: none.
    frames
        True if it takes frames; if not, its host may request them and gets none.
    """

    product_id: ClassVar[int]
    imu_units: ClassVar[tuple[int, ...]]

    size: tuple[int, int] = (0, 0)
    pulse_us: int = 100
    imu_unit: int = 0
    frames: bool = False
    system: SystemInfo = field(default_factory=SystemInfo)
    manufacturer: str = "iniVation"
    product: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (1 <= len(self.serial) <= 8 and self.serial.isascii() and self.serial.isprintable()):
            raise ValueError(f"serial {self.serial!r} must be 1 to 8 printable ASCII characters")
        if self.imu_unit not in (0, *self.imu_units):
            units = " or ".join(map(str, (0, *self.imu_units)))
            raise ValueError(f"imu_unit {self.imu_unit} must be {units}")
        if self.pulse_us < 1:
            raise ValueError(f"pulse_us {self.pulse_us} must be at least 1")

    @property
    def identity(self) -> Identity:
        """The camera as a host's bus lists it."""
        return Identity(VENDOR_ID, self.product_id, self.bcd_device, self.speed)

    @abstractmethod
    def registers(self) -> Iterator[Register]:
        """Yield its registers."""

    def descriptors(self) -> DescriptorSet:
        """Return all descriptors at the camera's speed."""
        other = OTHER_SPEED.get(self.speed)
        return DescriptorSet(
            device=DeviceDescriptor(self.speed, VENDOR_ID, self.product_id, self.bcd_device),
            configuration=_configuration(self.speed),
            strings={1: self.manufacturer, 2: self.product, 3: self.serial},
            other_speed=_configuration(other) if other else None,
        )


def _configuration(speed: Speed) -> Configuration:
    debug = Endpoint(
        DEBUG_ENDPOINT, TransferType.INTERRUPT, max_packet=64, interval=_DEBUG_INTERVAL[speed], bytes_per_interval=64
    )
    data = Endpoint(DATA_ENDPOINT, TransferType.BULK, max_packet=BULK_PACKET[speed], burst=7)
    return Configuration(speed, (Interface((debug, data)),))
