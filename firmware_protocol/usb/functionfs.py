"""Messages between a FunctionFS program and the kernel on ep0: descriptors and strings at first, then events.

Source: linux/usb/functionfs.h. All integers little-endian, w = 4 bytes.

    descriptors     wMagic=3 wLength wFlags wFullSpeed wHighSpeed wSuperSpeed (numbers of descriptors that follow)
                    interface, endpoints                        full speed
                    interface, endpoints                        high speed
                    interface, endpoints with companions        SuperSpeed
    strings         wMagic=2 wLength wStrings wLanguages
                    for each language: its code (2), then each string in UTF-8 with a NUL after it
    event (12)      setup packet (8; valid only for SETUP) type (1) 0 0 0

Lengths count the whole block. Endpoints must have the same addresses at all speeds; the controller replaces them.
Flags: 1, 2, 4 there are descriptors of full speed, high speed, SuperSpeed; 64 the program receives control requests to
all recipients, also those to the device; 128 also before the host has selected a configuration.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, IntFlag

from firmware_protocol.usb.descriptors import Interface, Speed
from firmware_protocol.usb.device import SetupPacket

EVENT_BYTES = 12

_DESCRIPTORS_MAGIC = 3
_STRINGS_MAGIC = 2
_HEAD = struct.Struct("<III")
_SPEEDS = (Speed.FULL, Speed.HIGH, Speed.SUPER)


class Flag(IntFlag):
    """Bits of the descriptors' flags."""

    FULL_SPEED = 1
    HIGH_SPEED = 2
    SUPER_SPEED = 4
    ALL_RECIPIENTS = 64
    BEFORE_CONFIGURATION = 128


class EventKind(IntEnum):
    """Type of an event."""

    BIND = 0
    UNBIND = 1
    ENABLE = 2
    DISABLE = 3
    SETUP = 4
    SUSPEND = 5
    RESUME = 6


@dataclass(frozen=True)
class Event:
    """An event at the device's port; `setup` is present for a SETUP."""

    kind: EventKind
    setup: SetupPacket | None = None

    @classmethod
    def parse(cls, data: bytes) -> Event:
        """Read the 12 bytes of an event; raises ValueError for another length, and for an unknown type."""
        if len(data) != EVENT_BYTES:
            raise ValueError(f"an event of FunctionFS has {EVENT_BYTES} bytes, got {len(data)}")
        kind = EventKind(data[8])
        return cls(kind, SetupPacket.parse(data[:8]) if kind is EventKind.SETUP else None)

    def __bytes__(self) -> bytes:
        return (bytes(8) if self.setup is None else bytes(self.setup)) + bytes((self.kind, 0, 0, 0))


def descriptor_block(interfaces: Mapping[Speed, Interface]) -> bytes:
    """Return the descriptors of an interface at all three speeds; ValueError if its endpoints differ between them."""
    addresses = {tuple(e.address for e in interfaces[speed].endpoints) for speed in _SPEEDS}
    if len(addresses) != 1:
        raise ValueError("an interface must have the same endpoints, in the same order, at all speeds")
    endpoints = len(interfaces[Speed.FULL].endpoints)
    body = struct.pack("<III", 1 + endpoints, 1 + endpoints, 1 + 2 * endpoints)
    body += b"".join(interfaces[speed].serialise(speed) for speed in _SPEEDS)
    flags = Flag.FULL_SPEED | Flag.HIGH_SPEED | Flag.SUPER_SPEED | Flag.ALL_RECIPIENTS | Flag.BEFORE_CONFIGURATION
    return _HEAD.pack(_DESCRIPTORS_MAGIC, _HEAD.size + len(body), flags) + body


NO_STRINGS = _HEAD.pack(_STRINGS_MAGIC, _HEAD.size + 4, 0) + bytes(4)
"""Strings of an interface that has none, and so no language either: a camera's strings are those of its device."""
