"""USB descriptors as values that serialise to the bytes a host reads (USB 2.0 section 9.6, USB 3.2 section 9.6).

All integers little-endian. b = 1 byte, w = 2 bytes, in wire order:

    device (18)            bLength bType=1 wUsb bClass bSubClass bProtocol bMaxPacket0 wVendor wProduct wDevice
                           bManufacturer bProduct bSerial bConfigurations
    qualifier (10)         bLength bType=6 wUsb bClass bSubClass bProtocol bMaxPacket0 bConfigurations 0
    configuration (9)      bLength bType=2 wTotalLength bInterfaces bValue bString bAttributes bMaxPower
      interface (9)        bLength bType=4 bNumber bAlternate bEndpoints bClass bSubClass bProtocol bString
        endpoint (7)       bLength bType=5 bAddress bAttributes wMaxPacket bInterval
        companion (6)      bLength bType=0x30 bMaxBurst bAttributes wBytesPerInterval     SuperSpeed only
    BOS (5)                bLength bType=15 wTotalLength bCapabilities
      USB 2.0 extension    7 bType=16 2 attributes(4)
      SuperSpeed           10 bType=16 3 bAttributes wSpeeds bFunctionality bU1Latency wU2Latency
    string (2 + 2n)        bLength bType=3 UTF-16LE text, or language identifiers for index 0

Differences by speed: bMaxPacket0 is an exponent (9) at SuperSpeed and a size below it, bMaxPower counts 8 mA at
SuperSpeed and 2 mA below, and only SuperSpeed endpoints have companions.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum


class Speed(IntEnum):
    """Speed codes as USB/IP and the kernel number them."""

    LOW = 1
    FULL = 2
    HIGH = 3
    SUPER = 5


ENGLISH_US = 0x0409
MAX_STRING_CHARACTERS = 126
BULK_PACKET = {Speed.SUPER: 1024, Speed.HIGH: 512, Speed.FULL: 64}
OTHER_SPEED = {Speed.HIGH: Speed.FULL, Speed.FULL: Speed.HIGH}


class DescriptorType(IntEnum):
    """High byte of wValue in GET_DESCRIPTOR."""

    DEVICE = 0x01
    CONFIGURATION = 0x02
    STRING = 0x03
    INTERFACE = 0x04
    ENDPOINT = 0x05
    DEVICE_QUALIFIER = 0x06
    OTHER_SPEED_CONFIGURATION = 0x07
    BOS = 0x0F
    DEVICE_CAPABILITY = 0x10
    ENDPOINT_COMPANION = 0x30


class TransferType(IntEnum):
    """Bits 1..0 of an endpoint's bmAttributes."""

    CONTROL = 0
    ISOCHRONOUS = 1
    BULK = 2
    INTERRUPT = 3


def _sized(kind: DescriptorType, body: bytes) -> bytes:
    return bytes((len(body) + 2, kind)) + body


@dataclass(frozen=True)
class Endpoint:
    """One endpoint at one speed.

    `address` carries the direction in bit 7 (1 = IN). `burst` (packets beyond the first) and `bytes_per_interval`
    appear in the companion, which only SuperSpeed has.
    """

    address: int
    transfer_type: TransferType
    max_packet: int
    interval: int = 0
    burst: int = 0
    bytes_per_interval: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.max_packet <= 1024:
            raise ValueError(f"endpoint 0x{self.address:02X}: max_packet {self.max_packet} is not in 1..1024")
        if not 0 <= self.burst <= 15:
            raise ValueError(f"endpoint 0x{self.address:02X}: burst {self.burst} is not in 0..15")

    def serialise(self, speed: Speed) -> bytes:
        """Return the endpoint descriptor, and its companion at SuperSpeed."""
        body = struct.pack("<BBHB", self.address, self.transfer_type, self.max_packet, self.interval)
        endpoint = _sized(DescriptorType.ENDPOINT, body)
        if speed is not Speed.SUPER:
            return endpoint
        companion = struct.pack("<BBH", self.burst, 0, self.bytes_per_interval)
        return endpoint + _sized(DescriptorType.ENDPOINT_COMPANION, companion)


@dataclass(frozen=True)
class Interface:
    """One interface in its only alternate setting, 0."""

    endpoints: tuple[Endpoint, ...]
    number: int = 0
    interface_class: tuple[int, int, int] = (0xFF, 0, 0)

    def serialise(self, speed: Speed) -> bytes:
        """Return the interface descriptor followed by its endpoints."""
        body = bytes((self.number, 0, len(self.endpoints), *self.interface_class, 0))
        return _sized(DescriptorType.INTERFACE, body) + b"".join(e.serialise(speed) for e in self.endpoints)


@dataclass(frozen=True)
class Configuration:
    """One configuration at one speed, with its interfaces and endpoints."""

    speed: Speed
    interfaces: tuple[Interface, ...]
    value: int = 1
    attributes: int = 0x80
    max_power_ma: int = 400

    def serialise(self, kind: DescriptorType = DescriptorType.CONFIGURATION) -> bytes:
        """Return the whole block; `kind` is OTHER_SPEED_CONFIGURATION if requested at another speed."""
        tree = b"".join(interface.serialise(self.speed) for interface in self.interfaces)
        power = self.max_power_ma // (8 if self.speed is Speed.SUPER else 2)
        count = len(self.interfaces)
        body = struct.pack("<HBBBBB", 9 + len(tree), count, self.value, 0, self.attributes, power)
        return _sized(kind, body) + tree

    def __bytes__(self) -> bytes:
        return self.serialise()

    @property
    def endpoint_addresses(self) -> frozenset[int]:
        """Addresses of all endpoints except 0."""
        return frozenset(e.address for interface in self.interfaces for e in interface.endpoints)


_BCD_USB = {Speed.SUPER: 0x0300, Speed.HIGH: 0x0210, Speed.FULL: 0x0210}
_MAX_PACKET_0 = {Speed.SUPER: 9, Speed.HIGH: 64, Speed.FULL: 64}


@dataclass(frozen=True)
class DeviceDescriptor:
    """Device descriptor. `strings` holds the string indices of manufacturer, product and serial number (0 = none).

    `bcd_usb`: version of USB, for a device that does not have the one of its speed.
    """

    speed: Speed
    vendor_id: int
    product_id: int
    bcd_device: int
    device_class: tuple[int, int, int] = (0, 0, 0)
    strings: tuple[int, int, int] = (1, 2, 3)
    bcd_usb: int | None = None

    def __post_init__(self) -> None:
        if self.speed not in _BCD_USB:
            raise ValueError(f"a device at {self.speed.name} speed is not supported; use FULL, HIGH or SUPER")

    def __bytes__(self) -> bytes:
        head = struct.pack("<H4B", self.bcd_usb or _BCD_USB[self.speed], *self.device_class, _MAX_PACKET_0[self.speed])
        ids = struct.pack("<HHH", self.vendor_id, self.product_id, self.bcd_device)
        return _sized(DescriptorType.DEVICE, head + ids + bytes((*self.strings, 1)))

    @property
    def qualifier(self) -> bytes:
        """Device qualifier of a USB 2 device: its properties at the other of full and high speed."""
        version = self.bcd_usb or _BCD_USB[Speed.HIGH]
        body = struct.pack("<H6B", version, *self.device_class, _MAX_PACKET_0[Speed.HIGH], 1, 0)
        return _sized(DescriptorType.DEVICE_QUALIFIER, body)


_EXTENSION = struct.pack("<BI", 2, 2)  # USB 2.0 extension: link power management
_SUPER_SPEED = struct.pack("<BBHBBH", 3, 0, 0x000E, 3, 0, 0)  # speeds, the least one with all functions, latencies
_CAPABILITIES = b"".join(_sized(DescriptorType.DEVICE_CAPABILITY, body) for body in (_EXTENSION, _SUPER_SPEED))
BOS = _sized(DescriptorType.BOS, struct.pack("<HB", 5 + len(_CAPABILITIES), 2)) + _CAPABILITIES
"""Binary device object store: USB 2.0 extension and SuperSpeed capability."""


def string_descriptor(text: str) -> bytes:
    """Return the string descriptor of `text`; raises ValueError beyond 126 UTF-16 units."""
    body = text.encode("utf-16-le")
    if len(body) > 2 * MAX_STRING_CHARACTERS:
        raise ValueError(f"a USB string holds at most {MAX_STRING_CHARACTERS} characters, got {len(body) // 2}")
    return _sized(DescriptorType.STRING, body)


LANGUAGE_DESCRIPTOR = _sized(DescriptorType.STRING, struct.pack("<H", ENGLISH_US))
"""String descriptor 0: the language of the other strings."""


@dataclass(frozen=True)
class DescriptorSet:
    """All descriptors that GET_DESCRIPTOR can request, at the present speed of the device.

    `other_speed` is the configuration at the other of full and high speed; None at SuperSpeed, where neither it nor a
    device qualifier exists.
    """

    device: DeviceDescriptor
    configuration: Configuration
    bos: bytes | None = BOS
    strings: Mapping[int, str] = field(default_factory=dict)
    other_speed: Configuration | None = None

    def __post_init__(self) -> None:
        if self.device.speed is not self.configuration.speed:
            raise ValueError("the device and its configuration must be described at the same speed")

    def find(self, kind: int, index: int) -> bytes | None:
        """Return the bytes of descriptor `kind`, `index`; None if there is no such descriptor."""
        if kind != DescriptorType.STRING:
            return self._only(kind) if index == 0 else None
        if index == 0:
            return LANGUAGE_DESCRIPTOR if self.strings else None
        return string_descriptor(self.strings[index]) if index in self.strings else None

    def _only(self, kind: int) -> bytes | None:
        if kind == DescriptorType.DEVICE:
            return bytes(self.device)
        if kind == DescriptorType.CONFIGURATION:
            return bytes(self.configuration)
        if kind == DescriptorType.BOS:
            return self.bos
        if kind == DescriptorType.DEVICE_QUALIFIER and self.other_speed is not None:
            return self.device.qualifier
        if kind == DescriptorType.OTHER_SPEED_CONFIGURATION and self.other_speed is not None:
            return self.other_speed.serialise(DescriptorType.OTHER_SPEED_CONFIGURATION)
        return None
