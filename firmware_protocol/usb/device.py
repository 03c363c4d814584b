"""Interface of a USB device to its transport (USB/IP, FunctionFS, a test).

A device is sans-I/O: it answers control requests, returns data on request, and receives the outcome of each transfer.
It never waits; where a real device would answer NAK, `read` returns None.

Setup packet, 8 bytes, little-endian (USB 2.0, section 9.3):

    0 bmRequestType   bit 7 direction (1 = IN), bits 6..5 type (0 standard, 1 class, 2 vendor), bits 4..0 recipient
    1 bRequest
    2 wValue   4 wIndex   6 wLength
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import ClassVar

from firmware_protocol.device.event_device import EventDevice
from firmware_protocol.device.items import Items
from firmware_protocol.usb.descriptors import DescriptorSet, Speed


class Stall(Exception):
    """The device refuses a request; the host gets a STALL handshake (EPIPE)."""


class NotReady(Exception):
    """The device has no answer yet (NAK): repeat the request with the same SetupPacket object, which identifies it."""


class RequestKind(IntEnum):
    """Bits 6..5 of bmRequestType."""

    STANDARD = 0
    CLASS = 1
    VENDOR = 2
    RESERVED = 3


@dataclass(frozen=True)
class SetupPacket:
    """The eight bytes that open a control transfer."""

    request_type: int
    request: int
    value: int
    index: int
    length: int

    @classmethod
    def parse(cls, data: bytes) -> SetupPacket:
        """Read the 8 setup bytes; raises ValueError on any other length."""
        if len(data) != 8:
            raise ValueError(f"a setup packet has 8 bytes, got {len(data)}")
        return cls(*struct.unpack("<BBHHH", data))

    def __bytes__(self) -> bytes:
        return struct.pack("<BBHHH", self.request_type, self.request, self.value, self.index, self.length)

    @property
    def is_in(self) -> bool:
        """True when the data stage goes from device to host."""
        return bool(self.request_type & 0x80)

    @property
    def kind(self) -> RequestKind:
        """Standard, class or vendor."""
        return RequestKind((self.request_type >> 5) & 3)

    @property
    def recipient(self) -> int:
        """0 device, 1 interface, 2 endpoint, 3 other."""
        return self.request_type & 0x1F


@dataclass(frozen=True)
class Identity:
    """Identity of a device before any request (the USB/IP device record)."""

    vendor_id: int
    product_id: int
    bcd_device: int
    speed: Speed
    device_class: tuple[int, int, int] = (0, 0, 0)
    interfaces: tuple[tuple[int, int, int], ...] = ((0xFF, 0, 0),)
    configuration_value: int = 1
    configurations: int = 1


@dataclass(frozen=True)
class Transfer(Items):
    """Data that left a device in answer to one IN request, and the items that they complete."""

    data: bytes = b""


class UsbDevice(ABC):
    """One USB device, without a transport.

    Order of calls: `attached` when a host takes the device, then any number of `control`, `read` and `write`, then
    `detached`. Exactly one of `sent` and `lost` follows for each Transfer that `read` returned, in the same order.
    """

    @property
    @abstractmethod
    def identity(self) -> Identity:
        """Vendor, product, speed and interfaces."""

    @abstractmethod
    def attached(self) -> None:
        """Set the power-on state: a host has attached the device."""

    @abstractmethod
    def detached(self) -> None:
        """Drop and count the data that still wait: the host is gone."""

    @abstractmethod
    def control(self, setup: SetupPacket, data: bytes) -> bytes:
        """Execute one control transfer; return the IN data stage, at most `setup.length` bytes, empty for OUT.

        `data` is the OUT data stage, empty for IN; if it is shorter than `setup.length`, the device decides. Raises
        Stall if the request is unknown or its data do not fit, and NotReady if the answer takes time: only a device
        with faults does.
        """

    @abstractmethod
    def read(self, endpoint: int, max_bytes: int) -> Transfer | None:
        """Return up to `max_bytes` from an IN endpoint (number without the direction bit, 1..15).

        Returns None while there is nothing to send. Raises Stall for an endpoint that does not exist or is halted.
        """

    def accepts(self, setup: SetupPacket) -> bool:
        """Return true if the data of this OUT request are accepted; for transports that cannot refuse them later."""
        return True

    def name_request(self, setup: SetupPacket, data: bytes) -> str:
        """Return a vendor request in words, for a trace; empty if it has no name. `data` are those of its OUT stage."""
        return ""

    def name_answer(self, setup: SetupPacket, data: bytes) -> str:
        """Return the answer to a request in words; empty if it has no name."""
        return ""

    def flushes(self, endpoint: int) -> int:
        """Number of times that the stream of an IN endpoint has ended, which invalidates transfers read before."""
        return 0

    def write(self, endpoint: int, data: bytes) -> None:
        """Process `data` that the host sends to an OUT endpoint (number 1..15).

        Raises Stall for an endpoint that does not exist or is halted: most cameras have none.
        """
        raise Stall(f"there is no OUT endpoint {endpoint}")

    @abstractmethod
    def sent(self, transfer: Transfer) -> None:
        """Note that `transfer` has left for the host: its events count as delivered."""

    @abstractmethod
    def lost(self, transfer: Transfer) -> None:
        """Note that `transfer` was taken from the device and lost on the link: its events count as dropped there."""


@dataclass(frozen=True)
class UsbCameraSettings(ABC):
    """Settings that all cameras on USB share.

    Attributes
    ----------
    serial : its serial number.
    bcd_device : version of the device, in its descriptor.
    fifo_bytes : room for data that wait for the host.
    start_delay_us : silence after the stream starts, stream time: the fault of drivers in `fx3.camera`.
    """

    serial: str = "00000346"
    bcd_device: int = 0
    speed: Speed = Speed.SUPER
    fifo_bytes: int = 256 * 1024
    start_delay_us: int = 300_000

    def __post_init__(self) -> None:
        if not 0 <= self.bcd_device <= 0xFFFF:
            raise ValueError(f"bcd_device {self.bcd_device:#x} does not fit 16 bits")
        if self.start_delay_us < 0:
            raise ValueError(f"start_delay_us {self.start_delay_us} must not be negative")

    @property
    @abstractmethod
    def identity(self) -> Identity:
        """The camera as a host's bus lists it."""

    @abstractmethod
    def descriptors(self) -> DescriptorSet:
        """Return all descriptors at the camera's speed."""


class UsbCamera(EventDevice, UsbDevice):
    """An event camera on USB: an event device with a USB side; `data_endpoint`: the IN endpoint of its events."""

    data_endpoint: ClassVar[int]
    settings: UsbCameraSettings
    _flushes = 0

    @property
    def identity(self) -> Identity:
        """Vendor, product, speed and interfaces."""
        return self.settings.identity

    def descriptors(self, speed: Speed) -> DescriptorSet:
        """Return the answers to GET_DESCRIPTOR at a speed, FULL, HIGH or SUPER."""
        return replace(self.settings, speed=speed).descriptors()

    def flushes(self, endpoint: int) -> int:
        """Number of times that the stream of events was stopped, or started anew, or lost power."""
        return self._flushes if endpoint & 0x0F == self.data_endpoint else 0

    def attached(self) -> None:
        """Set the power-on state: a host has attached the camera."""
        self._power_on()

    def detached(self) -> None:
        """Stop the camera: the host is gone. Waiting items are dropped and counted."""
        self._power_on()

    @abstractmethod
    def _power_on(self) -> None:
        """Set the power-on state; what waits is dropped and counted."""
