"""What an EVK4 is before it runs: who it says it is and its sizes; and the descriptors that follow.

Sources: what OpenEB 5.1.1 and neuromorphic_drivers check. Device version, release and build date of a shipped camera
are not public: those here are new enough for both.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from firmware_protocol.imx636.bias_effects import BiasModel
from firmware_protocol.imx636.registers import SIZE, Surroundings
from firmware_protocol.usb.descriptors import (
    Configuration,
    DescriptorSet,
    DeviceDescriptor,
    Endpoint,
    Interface,
    TransferType,
)
from firmware_protocol.usb.device import Identity, Speed

__all__ = ["ANSWER_ENDPOINT", "DATA_ENDPOINT", "REQUEST_ENDPOINT", "Evk4Settings"]

VENDOR_ID = 0x04B4
PRODUCT_ID = 0x00F5
ANSWER_ENDPOINT = 0x82
REQUEST_ENDPOINT = 0x02
DATA_ENDPOINT = 0x81

_INTERFACE_CLASS = (0xFF, 0x19, 0)
_BULK_PACKET = {Speed.SUPER: 1024, Speed.HIGH: 512, Speed.FULL: 64}
_OTHER_SPEED = {Speed.HIGH: Speed.FULL, Speed.FULL: Speed.HIGH}


@dataclass(frozen=True)
class Evk4Settings:
    """A camera's settings.

    Attributes
    ----------
    serial
        1 to 8 hexadecimal digits.
    fifo_bytes
        Room for events that wait for the host, at 6 bytes each: time, row and column.
    start_delay_us
        Silence after the sensor starts, stream time; see `davis346.quirks`, the driver's race is the same.
    release
        Firmware version, 0x00MMmmpp; OpenEB refuses below 0x030800.
    build_unix_s
        When that was built.
    biases
        What biases do to the sensor.
    """

    serial: str = "00000346"
    speed: Speed = Speed.SUPER
    fifo_bytes: int = 256 * 1024
    start_delay_us: int = 300_000
    bcd_device: int = 0x0309
    release: int = 0x03_0900
    build_unix_s: int = 1_700_000_000
    surroundings: Surroundings = field(default_factory=Surroundings)
    biases: BiasModel = field(default_factory=BiasModel)

    def __post_init__(self) -> None:
        if not 1 <= len(self.serial) <= 8 or set(self.serial) - set("0123456789abcdefABCDEF"):
            raise ValueError(f"the serial of an EVK4 has 1 to 8 hexadecimal digits, got {self.serial!r}")
        if self.fifo_bytes < 1024:
            raise ValueError(f"fifo_bytes must be at least 1024, got {self.fifo_bytes}")
        if self.start_delay_us < 0:
            raise ValueError(f"start_delay_us {self.start_delay_us} must not be negative")

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the sensor, pixels."""
        return SIZE

    @property
    def identity(self) -> Identity:
        """The camera as a host's bus lists it."""
        return Identity(VENDOR_ID, PRODUCT_ID, self.bcd_device, self.speed, interfaces=(_INTERFACE_CLASS,))

    def descriptors(self) -> DescriptorSet:
        """Return all descriptors at the camera's speed."""
        other = _OTHER_SPEED.get(self.speed)
        return DescriptorSet(
            device=DeviceDescriptor(self.speed, VENDOR_ID, PRODUCT_ID, self.bcd_device, strings=(1, 2, 0)),
            configuration=_configuration(self.speed),
            strings={1: "Prophesee", 2: "EVK4"},
            other_speed=_configuration(other) if other else None,
        )


def _configuration(speed: Speed) -> Configuration:
    """OpenEB wants these three endpoints in this order."""
    addresses = (ANSWER_ENDPOINT, REQUEST_ENDPOINT, DATA_ENDPOINT)
    endpoints = tuple(Endpoint(each, TransferType.BULK, _BULK_PACKET[speed], burst=15) for each in addresses)
    return Configuration(speed, (Interface(endpoints, interface_class=_INTERFACE_CLASS),))
