"""The standard requests of chapter 9, answered for any device (USB 2.0 section 9.4, USB 3.2 section 9.4).

    bRequest            direction  recipient                  data
    0  GET_STATUS       IN         device interface endpoint  2 bytes
    1  CLEAR_FEATURE    OUT        device interface endpoint  -
    3  SET_FEATURE      OUT        device interface endpoint  -
    5     SET_ADDRESS      OUT        device                     -        done by the host controller: acknowledged
    6  GET_DESCRIPTOR   IN         device                     cut to wLength
    8  GET_CONFIGURATION IN        device                     1 byte
    9     SET_CONFIGURATION OUT       device                     -
    10 GET_INTERFACE    IN         interface                  1 byte
    11 SET_INTERFACE    OUT        interface                  -        alternate setting 0 only
    0x30 SET_SEL        OUT        device                     6 bytes  SuperSpeed exit latencies, acknowledged
    0x31 SET_ISOCH_DELAY OUT       device                     -        SuperSpeed, acknowledged

All other requests stall. The language of a string request is ignored: each device here has strings in one language.

`name_request` gives control requests in words: those of chapter 9 by name, others by their numbers.
"""

from __future__ import annotations

from enum import IntEnum

from firmware_protocol.usb.descriptors import DescriptorSet, DescriptorType, Speed
from firmware_protocol.usb.device import RequestKind, SetupPacket, Stall


class StandardRequest(IntEnum):
    """bRequest of a standard request."""

    GET_STATUS = 0
    CLEAR_FEATURE = 1
    SET_FEATURE = 3
    SET_ADDRESS = 5
    GET_DESCRIPTOR = 6
    GET_CONFIGURATION = 8
    SET_CONFIGURATION = 9
    GET_INTERFACE = 10
    SET_INTERFACE = 11
    SET_SEL = 0x30
    SET_ISOCH_DELAY = 0x31


class Recipient(IntEnum):
    """Bits 4..0 of bmRequestType."""

    DEVICE = 0
    INTERFACE = 1
    ENDPOINT = 2


class Feature(IntEnum):
    """wValue of SET_FEATURE and CLEAR_FEATURE; the meaning depends on the recipient."""

    ENDPOINT_HALT = 0
    FUNCTION_SUSPEND = 0
    U1_ENABLE = 48
    U2_ENABLE = 49


_SELF_POWERED = 0x40
_SEL_BYTES = 6


class StandardControl:
    """State that chapter 9 gives to a device: its configuration, halted endpoints and link features."""

    def __init__(self, descriptors: DescriptorSet) -> None:
        self._descriptors = descriptors
        self._endpoints = descriptors.configuration.endpoint_addresses
        self._interfaces = frozenset(i.number for i in descriptors.configuration.interfaces)
        self.power_on()

    def power_on(self) -> None:
        """Return to the state after a bus reset: not configured, nothing halted."""
        self._configuration = 0
        self._halted: set[int] = set()
        self._features: set[int] = set()

    @property
    def configured(self) -> bool:
        """True after SET_CONFIGURATION with the device's configuration value."""
        return self._configuration != 0

    def require(self, address: int) -> None:
        """Raise Stall unless the endpoint at `address` (with direction bit) exists, is configured and not halted."""
        if address not in self._endpoints or not self.configured or address in self._halted:
            raise Stall

    def control(self, setup: SetupPacket, data: bytes) -> bytes:
        """Answer one standard request; raises Stall for an unknown one."""
        if setup.kind is not RequestKind.STANDARD or setup.recipient > Recipient.ENDPOINT:
            raise Stall
        if setup.is_in:
            return self._answer(setup)[: setup.length]
        self._execute(setup, data)
        return b""

    def _answer(self, setup: SetupPacket) -> bytes:
        on_device = setup.recipient == Recipient.DEVICE
        if setup.request == StandardRequest.GET_STATUS:
            return self._status(setup).to_bytes(2, "little")
        if setup.request == StandardRequest.GET_DESCRIPTOR and on_device:
            descriptor = self._descriptors.find(setup.value >> 8, setup.value & 0xFF)
            if descriptor is None:
                raise Stall
            return descriptor
        if setup.request == StandardRequest.GET_CONFIGURATION and on_device:
            return bytes((self._configuration,))
        if setup.request == StandardRequest.GET_INTERFACE:
            self._require_interface(setup)
            return b"\0"
        raise Stall

    def _execute(self, setup: SetupPacket, data: bytes) -> None:
        if setup.request == StandardRequest.SET_SEL:
            self._require_super_speed()
            if setup.recipient != Recipient.DEVICE or len(data) != _SEL_BYTES:
                raise Stall
            return
        if setup.length or data:
            raise Stall
        if setup.request in (StandardRequest.SET_FEATURE, StandardRequest.CLEAR_FEATURE):
            self._feature(setup, setup.request == StandardRequest.SET_FEATURE)
        elif setup.request == StandardRequest.SET_INTERFACE:
            self._require_interface(setup)
            if setup.value != 0:
                raise Stall
            self._halted.clear()
        elif setup.recipient == Recipient.DEVICE:
            self._execute_device(setup)
        else:
            raise Stall

    def _execute_device(self, setup: SetupPacket) -> None:
        if setup.request == StandardRequest.SET_CONFIGURATION:
            if setup.value not in (0, self._descriptors.configuration.value):
                raise Stall
            self._configuration = setup.value
            self._halted.clear()
        elif setup.request == StandardRequest.SET_ISOCH_DELAY:
            self._require_super_speed()
        elif setup.request != StandardRequest.SET_ADDRESS:
            raise Stall

    def _require_interface(self, setup: SetupPacket) -> None:
        exists = setup.recipient == Recipient.INTERFACE and setup.index in self._interfaces
        if not exists or not self.configured:
            raise Stall

    def _require_super_speed(self) -> None:
        if self._descriptors.device.speed is not Speed.SUPER:
            raise Stall

    def _status(self, setup: SetupPacket) -> int:
        if setup.recipient == Recipient.ENDPOINT:
            return int(self._endpoint(setup.index) in self._halted)
        if setup.recipient == Recipient.INTERFACE:
            self._require_interface(setup)
            return 0
        self_powered = bool(self._descriptors.configuration.attributes & _SELF_POWERED)
        return self_powered | (Feature.U1_ENABLE in self._features) << 2 | (Feature.U2_ENABLE in self._features) << 3

    def _endpoint(self, index: int) -> int:
        """Address named by wIndex; endpoint 0 always exists."""
        if index & 0x7F and index not in self._endpoints:
            raise Stall
        return index

    def _feature(self, setup: SetupPacket, on: bool) -> None:
        if setup.recipient == Recipient.ENDPOINT and setup.value == Feature.ENDPOINT_HALT:
            self._change(self._halted, self._endpoint(setup.index), on)
        elif setup.recipient == Recipient.INTERFACE and setup.value == Feature.FUNCTION_SUSPEND:
            self._require_super_speed()
            self._require_interface(setup)
        elif setup.recipient == Recipient.DEVICE and setup.value in (Feature.U1_ENABLE, Feature.U2_ENABLE):
            self._require_super_speed()
            self._change(self._features, setup.value, on)
        else:
            raise Stall

    @staticmethod
    def _change(members: set[int], member: int, on: bool) -> None:
        if on:
            members.add(member)
        else:
            members.discard(member)


_MOST_SHOWN = 16
_REQUESTS = frozenset(map(int, StandardRequest))
_DESCRIPTORS = frozenset(map(int, DescriptorType))


def name_request(setup: SetupPacket, data: bytes) -> str:
    """Return a request in words; `data` are those of its OUT stage."""
    if setup.kind is RequestKind.STANDARD and setup.request in _REQUESTS:
        return f"{StandardRequest(setup.request).name}{_object(setup)}"
    kind = setup.kind.name.lower()
    numbers = f"{kind} request {setup.request:#04x}, value {setup.value:#06x}, index {setup.index:#06x}"
    shown = f": {data[:_MOST_SHOWN].hex(' ')}{' ...' if len(data) > _MOST_SHOWN else ''}" if data else ""
    return numbers + shown


def _object(setup: SetupPacket) -> str:
    match StandardRequest(setup.request):
        case StandardRequest.GET_DESCRIPTOR:
            kind, index = setup.value >> 8, setup.value & 0xFF
            name = DescriptorType(kind).name.lower() if kind in _DESCRIPTORS else f"{kind:#04x}"
            return f" {name} {index}"
        case StandardRequest.SET_CONFIGURATION | StandardRequest.SET_INTERFACE | StandardRequest.SET_ADDRESS:
            return f" {setup.value}"
        case StandardRequest.CLEAR_FEATURE | StandardRequest.SET_FEATURE if setup.recipient == Recipient.ENDPOINT:
            feature = "halt" if setup.value == Feature.ENDPOINT_HALT else str(setup.value)
            return f" {feature} of endpoint {setup.index:#04x}"
        case StandardRequest.CLEAR_FEATURE | StandardRequest.SET_FEATURE:
            return f" {setup.value}"
    return ""
