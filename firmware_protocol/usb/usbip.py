"""USB/IP messages, version 1.1.1: USB requests carried over a byte stream.

Source: Linux, Documentation/usb/usbip_protocol.rst and tools/usb/usbip/src/usbip_network.h. All integers are
big-endian except the eight setup bytes, which pass as they are on a cable.

The layouts are drawn in docs/protocol.md.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from firmware_protocol.usb.device import Identity, Speed

__all__ = [
    "DeviceListReply", "DeviceListRequest", "DeviceRecord", "ImportReply", "ImportRequest", "OpStatus", "Submit",
    "Submitted", "Unlink", "Unlinked", "UrbStatus", "UsbipError",
]  # fmt: skip

VERSION = 0x0111
REQ_DEVLIST, REP_DEVLIST = 0x8005, 0x0005
REQ_IMPORT, REP_IMPORT = 0x8003, 0x0003
CMD_SUBMIT, CMD_UNLINK, RET_SUBMIT, RET_UNLINK = 1, 2, 3, 4

OP_HEADER = struct.Struct(">HHI")
COUNT = struct.Struct(">I")
BUSID_BYTES = 32
RECORD = struct.Struct(">256s32sIIIHHHBBBBBB")
INTERFACE = struct.Struct(">BBBx")

URB_HEADER_BYTES = 48
SUBMIT = struct.Struct(">IIIIIIiiii8s")
UNLINK = struct.Struct(">IIIIII24x")
SUBMITTED = struct.Struct(">IIIIIiiiii8x")
UNLINKED = struct.Struct(">IIIIIi24x")


class UsbipError(Exception):
    """The peer broke the USB/IP protocol; the message says how. The connection cannot go on."""


class OpStatus(IntEnum):
    """What an operation came to (usbip_network.h, ST_*)."""

    OK = 0
    NOT_AVAILABLE = 1
    BUSY = 2
    FAULTY = 3
    NO_DEVICE = 4
    ERROR = 5


class UrbStatus(IntEnum):
    """What a URB came to: Linux errno, negated, whatever the machine at either end."""

    OK = 0
    STALL = -32  # EPIPE
    UNLINKED = -104  # ECONNRESET


class Submit(NamedTuple):
    """CMD_SUBMIT: one transfer asked of the device. `data` is the OUT data stage."""

    seqnum: int
    devid: int
    is_in: bool
    endpoint: int
    length: int
    setup: bytes = bytes(8)
    data: bytes = b""
    flags: int = 0
    interval: int = 0

    def __bytes__(self) -> bytes:
        header = SUBMIT.pack(
            CMD_SUBMIT, self.seqnum, self.devid, self.is_in, self.endpoint, self.flags, self.length, 0, 0,
            self.interval, self.setup,
        )  # fmt: skip
        return header + self.data


class Unlink(NamedTuple):
    """CMD_UNLINK: take back the URB with number `victim`."""

    seqnum: int
    devid: int
    victim: int

    def __bytes__(self) -> bytes:
        return UNLINK.pack(CMD_UNLINK, self.seqnum, self.devid, 0, 0, self.victim)


class Submitted(NamedTuple):
    """RET_SUBMIT: the answer to a Submit. `data` is the IN data stage; for OUT `actual_length` alone counts."""

    seqnum: int
    status: int
    actual_length: int
    data: bytes = b""

    @property
    def header(self) -> bytes:
        """The 48 bytes before the data, to be sent without copying the data."""
        return SUBMITTED.pack(RET_SUBMIT, self.seqnum, 0, 0, 0, self.status, self.actual_length, 0, 0, 0)

    def __bytes__(self) -> bytes:
        return self.header + self.data


class Unlinked(NamedTuple):
    """RET_UNLINK: the answer to an Unlink."""

    seqnum: int
    status: int

    def __bytes__(self) -> bytes:
        return UNLINKED.pack(RET_UNLINK, self.seqnum, 0, 0, 0, self.status)


@dataclass(frozen=True)
class DeviceRecord:
    """A device as a server lists it.

    Raises ValueError for a bus id that is empty, not ASCII, or longer than the field.
    """

    busid: str
    busnum: int
    devnum: int
    identity: Identity
    path: str = ""

    def __post_init__(self) -> None:
        if not self.busid.isascii() or not 0 < len(self.busid) < BUSID_BYTES:
            raise ValueError(f"a bus id has 1 to {BUSID_BYTES - 1} ASCII characters, got {self.busid!r}")

    @property
    def devid(self) -> int:
        """The number that URB headers carry."""
        return self.busnum << 16 | self.devnum

    @classmethod
    def parse(cls, data: bytes, interfaces: Sequence[tuple[int, int, int]] = ()) -> DeviceRecord:
        """Read a 312-byte record; raises UsbipError when its fields make no sense."""
        path, busid, busnum, devnum, speed, vid, pid, bcd, klass, sub, protocol, value, configs, _ = RECORD.unpack(data)
        try:
            identity = Identity(vid, pid, bcd, Speed(speed), (klass, sub, protocol), tuple(interfaces), value, configs)
            return cls(_text(busid), busnum, devnum, identity, _text(path))
        except ValueError as error:
            raise UsbipError(f"device record of the server makes no sense: {error}") from error

    def __bytes__(self) -> bytes:
        it = self.identity
        return RECORD.pack(
            self.path.encode(), self.busid.encode(), self.busnum, self.devnum, it.speed, it.vendor_id, it.product_id,
            it.bcd_device, *it.device_class, it.configuration_value, it.configurations, len(it.interfaces),
        )  # fmt: skip


@dataclass(frozen=True)
class DeviceListRequest:
    """REQ_DEVLIST: what devices are there?"""

    def __bytes__(self) -> bytes:
        return OP_HEADER.pack(VERSION, REQ_DEVLIST, 0)


@dataclass(frozen=True)
class DeviceListReply:
    """REP_DEVLIST."""

    devices: tuple[DeviceRecord, ...]

    def __bytes__(self) -> bytes:
        parts = [OP_HEADER.pack(VERSION, REP_DEVLIST, OpStatus.OK), COUNT.pack(len(self.devices))]
        for device in self.devices:
            parts.append(bytes(device))
            parts += [INTERFACE.pack(*interface) for interface in device.identity.interfaces]
        return b"".join(parts)


@dataclass(frozen=True)
class ImportRequest:
    """REQ_IMPORT: give me this device. A bus id that is not ASCII names no device and is refused as such."""

    busid: str

    @classmethod
    def parse(cls, field: bytes) -> ImportRequest:
        """Read the 32-byte bus id."""
        return cls(_text(field))

    def __bytes__(self) -> bytes:
        field = self.busid.encode("ascii", "replace")[: BUSID_BYTES - 1]
        return OP_HEADER.pack(VERSION, REQ_IMPORT, 0) + field.ljust(BUSID_BYTES, b"\0")


@dataclass(frozen=True)
class ImportReply:
    """REP_IMPORT: the device, or why not."""

    status: int
    device: DeviceRecord | None = None

    def __bytes__(self) -> bytes:
        return OP_HEADER.pack(VERSION, REP_IMPORT, self.status) + (bytes(self.device) if self.device else b"")


def _text(field: bytes) -> str:
    """Return the text before the first zero byte; bytes that are not ASCII become U+FFFD."""
    return field.split(b"\0", 1)[0].decode("ascii", "replace")
