"""Objects of CANopen, ECSS-E-ST-50-15C and SpaceCAN (SYNC, TIME, NMT, heartbeat, EMCY, SCET), and bus selection.

Multi-byte numbers of CANopen (CiA 301) are little-endian, spacecraft time is CUC and big-endian (CCSDS 301.0-B):

    SYNC       empty, or u8 counter 1..240
    TIME       u28 milliseconds since midnight | 4 bits 0 | u16 days since 1984-01-01
    NMT        u8 command | u8 node, 0: all nodes
    heartbeat  u8 state of the node (bit 7 is the toggle bit of node guarding, 0 here)
    EMCY       u16 error code | u8 error register | 5 bytes of the maker's own: here u32 events dropped | u8 0
    SCET       u32 seconds | u24 fractions of 2^-24 s, 59.6 ns

`dbc` lists the identifiers.

Bus selection: the master's heartbeat selects one of two buses (ECSS-E-ST-50-15C, section 4.8; SpaceCAN). A camera
starts on its default bus. When the master's heartbeat has been missing there for `heartbeat_ms`, it changes to the
other bus, and then changes again every `toggle_ms` until it receives one. After `toggles` changes without a heartbeat
it returns to its default bus and stays there; the next heartbeat on that bus restarts the procedure.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

SYNC_LAST = 240
"""The SYNC counter goes from 1 to 240 and on from 1."""

EMCY_NO_ERROR = 0x0000
"""The reported error is over."""

EMCY_OVERRUN = 0x8110
"""CAN overrun, objects lost: here, events were dropped."""

_DAY_MS = 86_400_000


class ObjectError(ValueError):
    """The data of a frame do not fit its object; the message gives the reason."""


class NodeState(IntEnum):
    """States of a node, as in its heartbeat."""

    BOOT = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class NmtCommand(IntEnum):
    """Commands of the network's master."""

    START = 0x01
    STOP = 0x02
    ENTER_PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


@dataclass(frozen=True)
class NmtOrder:
    """A command to one node, or to all with node 0."""

    command: NmtCommand
    node: int = 0

    def __bytes__(self) -> bytes:
        return bytes([self.command, self.node])

    @classmethod
    def parse(cls, data: bytes) -> NmtOrder:
        """Read the two bytes; raises ObjectError."""
        if len(data) != 2 or data[0] not in NmtCommand.__members__.values():
            raise ObjectError(f"not an NMT order: {data.hex(' ')}")
        return cls(NmtCommand(data[0]), data[1])


def parse_sync(data: bytes) -> int | None:
    """Return the counter of a SYNC, None if it has none; raises ObjectError."""
    if not data:
        return None
    if len(data) != 1 or not 1 <= data[0] <= SYNC_LAST:
        raise ObjectError(f"not a SYNC: {data.hex(' ')}")
    return data[0]


def next_sync(counter: int) -> int:
    """Return the counter that follows."""
    return counter % SYNC_LAST + 1


def parse_heartbeat(data: bytes) -> NodeState:
    """Return the state in a heartbeat; raises ObjectError."""
    if len(data) != 1 or data[0] & 0x7F not in NodeState.__members__.values():
        raise ObjectError(f"not a heartbeat: {data.hex(' ')}")
    return NodeState(data[0] & 0x7F)


@dataclass(frozen=True)
class TimeOfDay:
    """CANopen's TIME, to the millisecond: `ms` since midnight, `days` since 1984-01-01."""

    ms: int
    days: int

    def __post_init__(self) -> None:
        if not 0 <= self.ms < _DAY_MS or not 0 <= self.days <= 0xFFFF:
            raise ObjectError(f"no time of day: {self.ms} ms, day {self.days}")

    @property
    def us(self) -> int:
        """Microseconds since 1984-01-01."""
        return (self.days * _DAY_MS + self.ms) * 1000

    def __bytes__(self) -> bytes:
        return struct.pack("<IH", self.ms, self.days)

    @classmethod
    def parse(cls, data: bytes) -> TimeOfDay:
        """Read the six bytes; raises ObjectError."""
        if len(data) != 6:
            raise ObjectError(f"a TIME has 6 bytes, not {len(data)}")
        ms, days = struct.unpack("<IH", data)
        return cls(ms & 0x0FFF_FFFF, days)


@dataclass(frozen=True)
class Emergency:
    """An EMCY of a camera: the error, and the number of events dropped since the start."""

    code: int
    dropped: int = 0

    def __bytes__(self) -> bytes:
        # Error register (CiA 301, object 1001h): bit 0 generic, bit 4 communication.
        register = 0 if self.code == EMCY_NO_ERROR else 0x11
        return struct.pack("<HBIx", self.code, register, min(self.dropped, 0xFFFF_FFFF))

    @classmethod
    def parse(cls, data: bytes) -> Emergency:
        """Read the eight bytes; raises ObjectError."""
        if len(data) != 8:
            raise ObjectError(f"an EMCY has 8 bytes, not {len(data)}")
        code, _, dropped = struct.unpack("<HBIx", data)
        return cls(code, dropped)


def scet(t_us: int) -> bytes:
    """Return a time in us as CUC 4+3, rounded down to 2^-24 s; the seconds wrap after 2^32."""
    seconds, us = divmod(t_us, 1_000_000)
    return (seconds & 0xFFFF_FFFF).to_bytes(4, "big") + ((us << 24) // 1_000_000).to_bytes(3, "big")


def parse_scet(data: bytes) -> int:
    """Return the time of a CUC 4+3 in us, rounded up, so that `scet` returns the same bytes; raises ObjectError."""
    if len(data) != 7:
        raise ObjectError(f"a SCET has 7 bytes, not {len(data)}")
    fraction = int.from_bytes(data[4:], "big")
    return int.from_bytes(data[:4], "big") * 1_000_000 + -(-fraction * 1_000_000 >> 24)


@dataclass(frozen=True)
class SelectorSettings:
    """Conditions for a change of buses.

    Attributes
    ----------
    default : 0 for bus A, 1 for bus B.
    heartbeat_ms : consumer heartbeat time: longest accepted silence of the master.
    toggle_ms : T_toggle: time on one bus during a search.
    toggles : N_toggle: changes without a heartbeat before it stays on the default bus; 0: search without end.
    """

    default: int = 0
    heartbeat_ms: int = 2000
    toggle_ms: int = 2000
    toggles: int = 8

    def __post_init__(self) -> None:
        if self.default not in (0, 1):
            raise ValueError(f"default must be 0 (bus A) or 1 (bus B), got {self.default}")
        if self.heartbeat_ms < 1 or self.toggle_ms < 1 or self.toggles < 0:
            raise ValueError("heartbeat_ms and toggle_ms must be positive and toggles not negative")


class BusSelector:
    """Selects the bus on which the master is active; `active` is 0 or 1."""

    def __init__(self, settings: SelectorSettings, now_ns: int) -> None:
        self._settings = settings
        self.active = settings.default
        self.turns = 0
        self._in_vain = 0
        self._deadline_ns: int | None = now_ns + settings.heartbeat_ms * 1_000_000

    def heartbeat(self, bus: int, now_ns: int) -> None:
        """Process a heartbeat of the master; one on the bus that is not in use is ignored."""
        if bus == self.active:
            self._in_vain = 0
            self._deadline_ns = now_ns + self._settings.heartbeat_ms * 1_000_000

    def poll(self, now_ns: int) -> bool:
        """Advance time; return True if this changed the bus in use."""
        if self._deadline_ns is None or now_ns < self._deadline_ns:
            return False
        before = self.active
        if self._settings.toggles and self._in_vain >= self._settings.toggles:
            self.active, self._deadline_ns = self._settings.default, None
        else:
            self.active = 1 - self.active
            self._in_vain += 1
            self._deadline_ns = now_ns + self._settings.toggle_ms * 1_000_000
        self.turns += self.active != before
        return self.active != before
