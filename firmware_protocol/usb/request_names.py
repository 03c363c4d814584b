"""Control requests in words: those of chapter 9, and others by their numbers; see `control` for the requests."""

from __future__ import annotations

from firmware_protocol.usb.control import Feature, Recipient, StandardRequest
from firmware_protocol.usb.descriptors import DescriptorType
from firmware_protocol.usb.device import RequestKind, SetupPacket

__all__ = ["name_request"]

_MOST_SHOWN = 16
_REQUESTS = frozenset(map(int, StandardRequest))
_DESCRIPTORS = frozenset(map(int, DescriptorType))


def name_request(setup: SetupPacket, data: bytes) -> str:
    """Return what a request asks; `data` are those of its OUT stage."""
    if setup.kind is RequestKind.STANDARD and setup.request in _REQUESTS:
        return f"{StandardRequest(setup.request).name}{_object(setup)}"
    kind = setup.kind.name.lower()
    numbers = f"{kind} request {setup.request:#04x}, value {setup.value:#06x}, index {setup.index:#06x}"
    told = f": {data[:_MOST_SHOWN].hex(' ')}{' ...' if len(data) > _MOST_SHOWN else ''}" if data else ""
    return numbers + told


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
