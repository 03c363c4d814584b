"""GVCP, the control protocol of GigE Vision: requests and answers as bytes, all numbers big-endian.

    request   u8 0x42 | u8 flags | u16 command | u16 length of payload | u16 id, never 0 | payload
    answer    u16 status | u16 command + 1     | u16 length of payload | u16 id          | payload

    command        request's payload                  answer's payload
    DISCOVERY      -                                  the first 248 octets of the registers
    FORCEIP        u16 0 | u48 MAC | u96 0 | u32 address | u96 0 | u32 mask | u96 0 | u32 gateway
    PACKETRESEND   u16 channel | u16 block | u32 first | u32 last                           (none: packets come)
                   flag 0x10: u32 channel | u32 first | u32 last | u64 block
    READREG        n x u32 address                    n x u32
    WRITEREG       n x (u32 address | u32 value)      u16 0 | u16 registers written
    READMEM        u32 address | u16 0 | u16 octets   u32 address | octets
    WRITEMEM       u32 address | octets               u16 0 | u16 octets written
    ACTION         u32 device key | u32 group key | u32 group mask | with flag 0x80 u64 time    -

Source: GigE Vision 2.0 as implemented in the open by Aravis and Wireshark's dissector.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag

GVCP_PORT = 3956
_KEY = 0x42
_HEADER = struct.Struct(">BBHHH")
_ANSWER = struct.Struct(">HHHH")
_RESEND = struct.Struct(">HHII")
_RESEND_EXTENDED = struct.Struct(">IIIQ")
_ACTION = struct.Struct(">III")
_FORCE_IP = struct.Struct(">HHI12xI12xI12xI")


class Command(IntEnum):
    """Requests; an answer carries the number plus one. EVENT and EVENTDATA go from device to host: see `control`."""

    DISCOVERY = 0x0002
    FORCEIP = 0x0004
    PACKETRESEND = 0x0040
    READREG = 0x0080
    WRITEREG = 0x0082
    READMEM = 0x0084
    WRITEMEM = 0x0086
    EVENT = 0x00C0
    EVENTDATA = 0x00C2
    ACTION = 0x0100


class Flag(IntFlag):
    """Flags of a request; 0x10 also lets a DISCOVERY or an ACTION be answered by broadcast."""

    ACKNOWLEDGE = 0x01
    EXTENDED = 0x10
    SCHEDULED = 0x80


class Status(IntEnum):
    """Status of an answer or of a packet of the stream."""

    SUCCESS = 0x0000
    PACKET_RESENT = 0x0100
    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    BAD_ALIGNMENT = 0x8005
    ACCESS_DENIED = 0x8006
    BUSY = 0x8007
    PACKET_UNAVAILABLE = 0x800C
    INVALID_HEADER = 0x800E
    PACKET_REMOVED = 0x8012
    OVERFLOW = 0x8015
    ACTION_LATE = 0x8016


class Refused(Exception):
    """A request that the device does not fulfil."""

    def __init__(self, status: Status) -> None:
        super().__init__(status.name)
        self.status = status


@dataclass(frozen=True)
class Request:
    """A request as received.

    `command`: a `Command`, or an unknown number; `is_complete`: true if the payload is as long as the header states.
    """

    command: int
    flags: int
    id: int
    payload: bytes
    is_complete: bool = True

    @classmethod
    def of(cls, datagram: bytes) -> Request | None:
        """Return the request in a datagram; None if the datagram is no request that could be answered."""
        if len(datagram) < _HEADER.size:
            return None
        key, flags, command, length, number = _HEADER.unpack_from(datagram)
        if key != _KEY or number == 0:
            return None
        payload = datagram[_HEADER.size :]
        return cls(command, flags, number, payload, len(payload) == length)

    def numbers(self) -> tuple[int, ...]:
        """Return the payload as numbers of 32 bits; raises Refused for another length, and for none."""
        if not self.payload or len(self.payload) % 4:
            raise Refused(Status.INVALID_PARAMETER)
        return struct.unpack(f">{len(self.payload) // 4}I", self.payload)


@dataclass(frozen=True)
class Resend:
    """Packets `first` to `last`, both inclusive, of a block that a host requests again."""

    block: int
    first: int
    last: int

    @classmethod
    def of(cls, request: Request) -> Resend:
        """Return the content of a PACKETRESEND; raises Refused for another length or range."""
        extended = bool(request.flags & Flag.EXTENDED)
        layout = _RESEND_EXTENDED if extended else _RESEND
        if len(request.payload) != layout.size:
            raise Refused(Status.INVALID_PARAMETER)
        if extended:
            _, first, last, block = layout.unpack(request.payload)
        else:
            _, block, first, last = layout.unpack(request.payload)
        if last < first:
            raise Refused(Status.INVALID_PARAMETER)
        return cls(block, first, last)


@dataclass(frozen=True)
class Action:
    """A request to all devices at once; `time_ns` None: now."""

    device_key: int
    group_key: int
    group_mask: int
    time_ns: int | None = None

    @classmethod
    def of(cls, request: Request) -> Action:
        """Return the content of an ACTION; raises Refused for another length."""
        scheduled = bool(request.flags & Flag.SCHEDULED)
        if len(request.payload) != _ACTION.size + 8 * scheduled:
            raise Refused(Status.INVALID_PARAMETER)
        device_key, group_key, group_mask = _ACTION.unpack_from(request.payload)
        time_ns = int.from_bytes(request.payload[_ACTION.size :], "big") if scheduled else None
        return cls(device_key, group_key, group_mask, time_ns)


@dataclass(frozen=True)
class ForcedAddress:
    """An address that a host assigns to the device with this MAC, all as numbers; 0: restart configuration."""

    mac: int
    address: int

    @classmethod
    def of(cls, request: Request) -> ForcedAddress:
        """Return the content of a FORCEIP; raises Refused for another length."""
        if len(request.payload) != _FORCE_IP.size:
            raise Refused(Status.INVALID_PARAMETER)
        _, high, low, address, _, _ = _FORCE_IP.unpack(request.payload)
        return cls(high << 32 | low, address)


def request(command: int, number: int, payload: bytes = b"", flags: int = Flag.ACKNOWLEDGE) -> bytes:
    """Return a request of a host."""
    return _HEADER.pack(_KEY, flags, command, len(payload), number) + payload


def answer(request: Request, payload: bytes = b"", status: Status = Status.SUCCESS) -> bytes:
    """Return the device's answer to a request."""
    return _ANSWER.pack(status, (request.command + 1) & 0xFFFF, len(payload), request.id) + payload
