"""Messages of the Precision Time Protocol as bytes, all numbers big-endian.

    header, 34 octets
      0  u4 standard | u4 type       16  u32 (not used)
      1  u4 minor version | u4 2     20  u64 clock | u16 port of the sender
      2  u16 octets of the message   30  u16 sequence
      4  u8 domain                   32  u8 (not used)
      5  u8 (standard, minor)        33  i8 log2 of the interval, s; 127: none
      6  u16 flags
      8  i64 correction, ns * 2^16

    type               after the header                                                      octets   port
    0 Sync             time at which it left; 0 if a Follow_Up has it (flag 0x0200)          44       319
    1 Delay_Req        0                                                                     44       319
    8 Follow_Up        time at which the Sync left                                           44       320
    9 Delay_Resp       time at which the Delay_Req arrived | u64 clock | u16 port of its sender   54   320
    B Announce         10 octets (not used) | i16 UTC offset, s | u8 0 | u8 priority 1 |
                       u8 class | u8 accuracy | u16 variance | u8 priority 2 | u64 grandmaster |
                       u16 steps removed | u8 source of time                                 64       320

    time               u48 s | u32 ns, below 10^9

A message may have more octets than these (TLVs), which are ignored. Of the standard's other messages (management,
signaling, peer delay) none is read.

Source: IEEE 1588-2019 as implemented in the open by linuxptp, and as shown by Wireshark's dissector.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import NamedTuple

EVENT_PORT = 319
GENERAL_PORT = 320
GROUP = "224.0.1.129"
_VERSION = 2
_NS_PER_S = 1_000_000_000
_MOST_SECONDS = 1 << 33  # year 2242: the sum with any correction fits into 63 bits of nanoseconds
_HEADER = struct.Struct(">BBHBBHq4xQHHBb")
_TIME = struct.Struct(">HII")
_IDENTITY = struct.Struct(">QH")
_ANNOUNCE = struct.Struct(">10xhxBBBHBQHB")
_CONTROL = 1  # of a Delay_Req, in the octet that receivers do not use
NO_INTERVAL = 127


class MessageType(IntEnum):
    """Types of messages that a slave reads or sends."""

    SYNC = 0x0
    DELAY_REQ = 0x1
    FOLLOW_UP = 0x8
    DELAY_RESP = 0x9
    ANNOUNCE = 0xB


class Flag(IntFlag):
    """Flags of the header."""

    ALTERNATE_MASTER = 0x0100
    TWO_STEP = 0x0200
    PTP_TIMESCALE = 0x0008


class PortIdentity(NamedTuple):
    """Identity of a port: its clock, 64 bits, and its number."""

    clock: int
    port: int


@dataclass(frozen=True)
class Header:
    """Header of a message.

    Attributes
    ----------
    correction_ns : time that the message stayed in bridges, ns, rounded down.
    log_interval : binary logarithm of the interval between such messages, s.
    """

    type: MessageType
    domain: int
    source: PortIdentity
    sequence: int
    flags: int = 0
    correction_ns: int = 0
    log_interval: int = NO_INTERVAL


@dataclass(frozen=True)
class Sync:
    """Sync: `time_ns` is the time at which it left, unless a Follow_Up has that."""

    header: Header
    time_ns: int


@dataclass(frozen=True)
class FollowUp:
    """Follow_Up: the time at which the Sync of the same sequence left."""

    header: Header
    time_ns: int


@dataclass(frozen=True)
class DelayResponse:
    """Delay_Resp: the time at which the Delay_Req of the same sequence arrived, and the port that had sent that."""

    header: Header
    time_ns: int
    requester: PortIdentity


@dataclass(frozen=True)
class Announce:
    """Announce: the grandmaster of a master, and how good it is.

    `quality`: (priority 1, class, accuracy, variance, priority 2); the lower is the better.
    """

    header: Header
    quality: tuple[int, int, int, int, int]
    grandmaster: int
    steps_removed: int
    utc_offset_s: int = 0
    time_source: int = 0xA0

    @property
    def rank(self) -> tuple[int, ...]:
        """Key by which masters are compared: the least is the best."""
        return (*self.quality, self.grandmaster, self.steps_removed, *self.header.source)


Message = Sync | FollowUp | DelayResponse | Announce


def clock_identity(mac: int) -> int:
    """Return the identity of a clock with this 48-bit MAC: FFFE between its halves."""
    return (mac >> 24) << 40 | 0xFFFE << 24 | mac & 0xFFFFFF


def parse(data: bytes) -> Message | None:
    """Return the message in a datagram; None if it is none that a slave reads, or is damaged."""
    header = _header_of(data)
    if header is None:
        return None
    body = data[_HEADER.size :]
    if header.type == MessageType.ANNOUNCE and len(body) >= _ANNOUNCE.size:
        utc_s, first, kind, accuracy, variance, second, grandmaster, steps, source = _ANNOUNCE.unpack_from(body)
        return Announce(header, (first, kind, accuracy, variance, second), grandmaster, steps, utc_s, source)
    time_ns = None if header.type in (MessageType.ANNOUNCE, MessageType.DELAY_REQ) else _time_of(body)
    if time_ns is None:
        return None
    if header.type == MessageType.DELAY_RESP:
        if len(body) < _TIME.size + _IDENTITY.size:
            return None
        return DelayResponse(header, time_ns, PortIdentity(*_IDENTITY.unpack_from(body, _TIME.size)))
    return (Sync if header.type == MessageType.SYNC else FollowUp)(header, time_ns)


def _header_of(data: bytes) -> Header | None:
    if len(data) < _HEADER.size:
        return None
    kind, version, octets, domain, minor, flags, correction, clock, port, sequence, _, log = _HEADER.unpack_from(data)
    if version & 0xF != _VERSION or kind >> 4 or minor or not _HEADER.size <= octets <= len(data):
        return None
    try:
        message = MessageType(kind)
    except ValueError:
        return None
    return Header(message, domain, PortIdentity(clock, port), sequence, flags, correction >> 16, log)


def _time_of(body: bytes) -> int | None:
    if len(body) < _TIME.size:
        return None
    numbers: tuple[int, int, int] = _TIME.unpack_from(body)
    high, low, nanoseconds = numbers
    seconds = high << 32 | low
    if seconds >= _MOST_SECONDS or nanoseconds >= _NS_PER_S:
        return None
    return seconds * _NS_PER_S + nanoseconds


def delay_request(source: PortIdentity, sequence: int, domain: int) -> bytes:
    """Return a Delay_Req."""
    octets = _HEADER.size + _TIME.size
    kind, interval = MessageType.DELAY_REQ, NO_INTERVAL
    header = _HEADER.pack(kind, _VERSION, octets, domain, 0, 0, 0, *source, sequence, _CONTROL, interval)
    return header + bytes(_TIME.size)
