"""USB/IP: messages of version 1.1.1, parsers for both ends, and records of URBs in the format of usbmon.

Source: Linux, Documentation/usb/usbip_protocol.rst and tools/usb/usbip/src/usbip_network.h. All integers are
big-endian except the eight setup bytes, which stay as they are on a cable. docs/cameras.md shows the layouts.

The parsers turn the bytes of a connection into messages, however the bytes were divided on the way. `receive` takes
bytes; `next_message` returns a message, and None when more bytes are needed. A parser holds at most one unfinished
message beyond the bytes that it received.

URB records have the form of Linux' usbmon, in a pcap file, which Wireshark and tshark open:

File, 24 bytes: magic 0xA1B2C3D4, version 2.4, zone 0, accuracy 0, longest record, link type 220 (USB_LINUX_MMAPPED).
Then for each record 16 bytes: seconds, microseconds, bytes stored, original bytes; and the record:

     0  u64  id            the same for the two records of a URB
     8  u8   type          'S' submitted by the host, 'C' completed
     9  u8   transfer      0 isochronous, 1 interrupt, 2 control, 3 bulk
    10  u8   endpoint      bit 7: IN
    11  u8   device        number on its bus
    12  u16  bus
    14  i8   no setup      0: the setup packet is present, else '-'
    15  i8   no data       0: data follow, else '<' (IN, submitted) or '>' (OUT, completed)
    16  i64  seconds
    24  i32  microseconds
    28  i32  status        0, or a negative errno; -115 (in progress) of a URB that is submitted
    32  u32  length        requested, or transferred
    36  u32  stored        bytes of data that follow
    40  u8[8]              the setup packet
    48  i32  interval      52 i32 start frame   56 u32 flags   60 u32 isochronous descriptors
    64  data

Little-endian. Sources: Documentation/usb/usbmon.rst of Linux (struct usbmon_packet), the pcap-savefile manual page,
and the list of link types of tcpdump.org.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import Identity

VERSION = 0x0111
REQ_DEVLIST, REP_DEVLIST = 0x8005, 0x0005
REQ_IMPORT, REP_IMPORT = 0x8003, 0x0003
CMD_SUBMIT = 1
CMD_UNLINK = 2
RET_SUBMIT = 3
RET_UNLINK = 4

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
    """The peer broke the USB/IP protocol; the message gives the reason. The connection cannot continue."""


class OpStatus(IntEnum):
    """Result of an operation (usbip_network.h, ST_*)."""

    OK = 0
    NOT_AVAILABLE = 1
    BUSY = 2
    FAULTY = 3
    NO_DEVICE = 4
    ERROR = 5


class UrbStatus(IntEnum):
    """Result of a URB: Linux errno, negated, on machines of any kind."""

    OK = 0
    STALL = -32  # EPIPE
    UNLINKED = -104  # ECONNRESET


class Submit(NamedTuple):
    """CMD_SUBMIT: one transfer requested of the device. `data` is the OUT data stage."""

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
    """CMD_UNLINK: cancel the URB with number `victim`."""

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
    """A device as a server lists it; ValueError for a bus id that is empty, not ASCII or longer than the field."""

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
        """Read a 312-byte record; raises UsbipError if its fields are invalid."""
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
    """REQ_DEVLIST: request for the list of devices."""

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
    """REQ_IMPORT: request for one device. A bus id that is not ASCII names no device and is refused as such."""

    busid: str

    def __bytes__(self) -> bytes:
        field = self.busid.encode("ascii", "replace")[: BUSID_BYTES - 1]
        return OP_HEADER.pack(VERSION, REQ_IMPORT, 0) + field.ljust(BUSID_BYTES, b"\0")


@dataclass(frozen=True)
class ImportReply:
    """REP_IMPORT: the device, or the reason of the refusal."""

    status: int
    device: DeviceRecord | None = None

    def __bytes__(self) -> bytes:
        return OP_HEADER.pack(VERSION, REP_IMPORT, self.status) + (bytes(self.device) if self.device else b"")


def _text(field: bytes) -> str:
    """Return the text before the first zero byte; bytes that are not ASCII become U+FFFD."""
    return field.split(b"\0", 1)[0].decode("ascii", "replace")


Request = DeviceListRequest | ImportRequest | Submit | Unlink
Reply = DeviceListReply | ImportReply | Submitted | Unlinked


@dataclass(frozen=True)
class Limits:
    """Limits of a peer's requests; beyond them it is treated as faulty.

    Attributes
    ----------
    in_bytes : longest IN transfer. 16 MiB is the most that Linux lets one usbfs user have in flight by default.
    out_bytes
        Longest OUT transfer, which is held in memory until it is complete. A control transfer has 65535 at most.
    devices : most devices a server may list; Linux has 8 controllers of 30 ports.
    """

    in_bytes: int = 16 << 20
    out_bytes: int = 1 << 20
    devices: int = 240


class _Parser:
    """Bytes of the other end: operations first, URBs after `begin_urbs`."""

    def __init__(self, limits: Limits = Limits()) -> None:
        self._limits = limits
        self._buffer = bytearray()
        self._urbs = False

    def _cut(self, start: int, stop: int) -> bytes | None:
        """Remove all bytes before `stop`, and return those from `start` on; None while some are missing."""
        if len(self._buffer) < stop:
            return None
        data = _copied(self._buffer, start, stop)
        del self._buffer[:stop]
        return data

    def receive(self, data: bytes | memoryview) -> None:
        """Append bytes as received."""
        self._buffer += data

    def begin_urbs(self) -> None:
        """Note that an import was granted: URBs, or replies to them, follow."""
        self._urbs = True


class ServerParser(_Parser):
    """The device's end: requests."""

    def next_message(self) -> Request | None:
        """Return the next complete message, None if more bytes are needed; raises UsbipError on an invalid one."""
        return self._next_urb() if self._urbs else self._next_operation()

    def _next_operation(self) -> DeviceListRequest | ImportRequest | None:
        head = OP_HEADER.size
        if len(self._buffer) < head:
            return None
        code, _ = _operation(self._buffer)
        if code == REQ_DEVLIST:
            del self._buffer[:head]
            return DeviceListRequest()
        if code != REQ_IMPORT:
            raise UsbipError(f"unknown operation 0x{code:04x}; known are 0x8005 (device list) and 0x8003 (import)")
        field = self._cut(head, head + BUSID_BYTES)
        return None if field is None else ImportRequest(_text(field))

    def _next_urb(self) -> Submit | Unlink | None:
        if len(self._buffer) < URB_HEADER_BYTES:
            return None
        command, seqnum, devid, direction, endpoint, *parameters = SUBMIT.unpack_from(self._buffer)
        if command == CMD_UNLINK:
            del self._buffer[:URB_HEADER_BYTES]
            return Unlink(seqnum, devid, parameters[0])
        if command != CMD_SUBMIT:
            raise UsbipError(f"unknown URB command 0x{command:08x}; known are 1 (submit) and 2 (unlink)")
        flags, length, _, packets, interval, setup = parameters
        self._check_submit(direction, endpoint, length, packets)
        data = self._cut(URB_HEADER_BYTES, URB_HEADER_BYTES + (0 if direction else length))
        if data is None:
            return None
        return Submit(seqnum, devid, bool(direction), endpoint, length, setup, data, flags, interval)

    def _check_submit(self, direction: int, endpoint: int, length: int, packets: int) -> None:
        if direction > 1:
            raise UsbipError(f"a URB has direction 0 (OUT) or 1 (IN), got {direction}")
        if endpoint > 15:
            raise UsbipError(f"endpoint numbers go from 0 to 15, got {endpoint}")
        if packets not in (0, -1):
            raise UsbipError(f"isochronous transfers are not served, got one of {packets} packets")
        _check_length(length, self._limits.in_bytes if direction else self._limits.out_bytes)


class HostParser(_Parser):
    """The host's end: replies. Call `expect` for each URB: its direction, not in a RET_SUBMIT, decides the layout."""

    def __init__(self, limits: Limits = Limits()) -> None:
        super().__init__(limits)
        self._lengths: dict[int, tuple[bool, int]] = {}

    def expect(self, urb: Submit) -> None:
        """Store the direction of a URB that was sent."""
        self._lengths[urb.seqnum] = (urb.is_in, urb.length)

    def forget(self, seqnum: int) -> None:
        """Remove a URB that was cancelled: no reply comes for it."""
        self._lengths.pop(seqnum, None)

    def next_message(self) -> Reply | None:
        """Return the next complete message, None if more bytes are needed; raises UsbipError on an invalid one."""
        return self._next_urb() if self._urbs else self._next_operation()

    def _next_operation(self) -> DeviceListReply | ImportReply | None:
        if len(self._buffer) < OP_HEADER.size:
            return None
        code, status = _operation(self._buffer)
        if code == REP_IMPORT:
            return self._next_import(status)
        if code == REP_DEVLIST:
            return self._next_device_list(status)
        raise UsbipError(f"unknown answer 0x{code:04x} to an operation; known are 0x0005 and 0x0003")

    def _next_import(self, status: int) -> ImportReply | None:
        head = OP_HEADER.size
        if status != OpStatus.OK:
            del self._buffer[:head]
            return ImportReply(status)
        record = self._cut(head, head + RECORD.size)
        return None if record is None else ImportReply(status, DeviceRecord.parse(record))

    def _next_device_list(self, status: int) -> DeviceListReply | None:
        if status != OpStatus.OK:
            raise UsbipError(f"the server refused to list its devices (status {status})")
        at = OP_HEADER.size + COUNT.size
        if len(self._buffer) < at:
            return None
        (count,) = COUNT.unpack_from(self._buffer, OP_HEADER.size)
        if count > self._limits.devices:
            raise UsbipError(f"a list of {count} devices is longer than the limit of {self._limits.devices}")
        devices = []
        for _ in range(count):
            device, at = self._device_at(at)
            if device is None:
                return None
            devices.append(device)
        del self._buffer[:at]
        return DeviceListReply(tuple(devices))

    def _device_at(self, at: int) -> tuple[DeviceRecord | None, int]:
        """Read a record and its interfaces; return it and the offset after them; no record while bytes are missing."""
        body = at + RECORD.size
        if len(self._buffer) < body:
            return None, at
        end = body + INTERFACE.size * self._buffer[body - 1]
        if len(self._buffer) < end:
            return None, at
        interfaces = [(a, b, c) for a, b, c in INTERFACE.iter_unpack(_copied(self._buffer, body, end))]
        return DeviceRecord.parse(_copied(self._buffer, at, body), interfaces), end

    def _next_urb(self) -> Submitted | Unlinked | None:
        head = URB_HEADER_BYTES
        if len(self._buffer) < head:
            return None
        command, seqnum, _, _, _, status, actual, *_ = SUBMITTED.unpack_from(self._buffer)
        if command == RET_UNLINK:
            del self._buffer[:head]
            return Unlinked(seqnum, status)
        if command != RET_SUBMIT:
            raise UsbipError(f"unknown URB answer 0x{command:08x}; known are 3 (submitted) and 4 (unlinked)")
        if seqnum not in self._lengths:
            raise UsbipError(f"an answer to URB {seqnum}, which is not pending")
        is_in, length = self._lengths[seqnum]
        _check_length(actual, length)
        data = self._cut(head, head + (actual if is_in else 0))
        if data is None:
            return None
        del self._lengths[seqnum]
        return Submitted(seqnum, status, actual, data)


def _operation(buffer: bytearray) -> tuple[int, int]:
    """Return (code, status) of the first operation in the buffer; raises UsbipError for an unsupported version."""
    version, code, status = OP_HEADER.unpack_from(buffer)
    if version != VERSION:
        raise UsbipError(f"USB/IP version 0x{version:04x} is not supported; version 0x{VERSION:04x} is")
    return code, status


def _copied(buffer: bytearray, start: int, stop: int) -> bytes:
    """Copy the slice once; `bytes(buffer[start:stop])` would copy it twice."""
    with memoryview(buffer) as view:
        return bytes(view[start:stop])


def _check_length(length: int, limit: int) -> None:
    if length < 0:
        raise UsbipError(f"a transfer cannot have {length} bytes")
    if length > limit:
        raise UsbipError(f"a transfer of {length} bytes is longer than the limit of {limit}")


MOST_BYTES = 262_144
"""Longest record; data beyond it are cut."""

IN_PROGRESS = -115

_LINK_TYPE = 220
_FILE = struct.Struct("<IHHiIII")
_PACKET = struct.Struct("<IIII")
_RECORD = struct.Struct("<QBBBBHbbqiiII8siiII")
_NO_SETUP = ord("-")
_CONTROL = 2

FILE_HEADER = _FILE.pack(0xA1B2C3D4, 2, 4, 0, 0, MOST_BYTES, _LINK_TYPE)


@dataclass(frozen=True)
class UrbRecord:
    """One of the two records of a URB.

    Attributes
    ----------
    t_us : unix time.
    devid : bus number and device number, as USB/IP has them: bus << 16 | device.
    length : bytes requested ('S') or transferred ('C').
    """

    urb: int
    t_us: int
    submitted: bool
    transfer_type: int
    endpoint: int
    is_in: bool
    devid: int
    status: int
    length: int
    setup: bytes = bytes(8)
    data: bytes = b""

    def __bytes__(self) -> bytes:
        data = self.data[: MOST_BYTES - _RECORD.size]
        seconds, us = divmod(self.t_us, 1_000_000)
        shown = self.submitted and self.transfer_type == _CONTROL
        header = _RECORD.pack(
            self.urb, ord("S" if self.submitted else "C"), self.transfer_type, self.endpoint | self.is_in << 7,
            self.devid & 0xFF, self.devid >> 16 & 0xFFFF, 0 if shown else _NO_SETUP,
            0 if data else ord("<" if self.is_in else ">"), seconds, us, self.status, self.length, len(data),
            self.setup if shown else bytes(8), 0, 0, 0x200 if self.is_in else 0, 0,
        )  # fmt: skip
        length = _RECORD.size + len(self.data)
        return _PACKET.pack(seconds & 0xFFFFFFFF, us, _RECORD.size + len(data), length) + header + data
