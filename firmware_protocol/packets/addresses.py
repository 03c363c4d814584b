"""Addresses of an instrument and its computer on the link, messages with their kinds, and sequence counts.

A message is the same in every packet standard. A sender numbers its packets; a receiver compares the numbers with those
it expects, and counts the packets that are missing. A packet that a receiver refuses raises PacketError.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable
from dataclasses import dataclass
from enum import Enum

_APIDS = range(1, 0x7FF)


@dataclass(frozen=True)
class Addresses:
    """Identifiers of one instrument; both sides need the same. Raises ValueError for one out of range.

    Attributes
    ----------
    apid : application process of the instrument: telecommands, and all its messages except events.
    science_apid : application process of events and edges.
    csp_node, csp_peer : CSP addresses of the instrument and of the computer, 0..16383 (version 2).
    """

    apid: int = 0x2A0
    science_apid: int = 0x2A1
    csp_node: int = 10
    csp_peer: int = 1

    def __post_init__(self) -> None:
        for apid in (self.apid, self.science_apid):
            if apid not in _APIDS:
                raise ValueError(f"APID {apid:#x} is not in 0x001..0x7fe")
        if self.apid == self.science_apid:
            raise ValueError(f"events need an APID of their own, both are {self.apid:#x}")
        for node in (self.csp_node, self.csp_peer):
            if not 0 <= node < 1 << 14:
                raise ValueError(f"CSP address {node} is not in 0..16383")


DEFAULT_ADDRESSES = Addresses()


class PacketError(ValueError):
    """A packet is malformed or for another receiver. The message is the reason under which it is counted."""


class MessageKind(Enum):
    """Kinds of messages, with their payloads."""

    EVENTS = "events"
    """One event block (firmware_protocol.telemetry)."""
    EDGES = "edges"
    """One block of edges (firmware_protocol.telemetry)."""
    HOUSEKEEPING = "housekeeping"
    """`Housekeeping`."""
    VERIFICATION = "verification"
    """`Verification`."""
    TIME = "time"
    """`TimeReport`."""
    PONG = "pong"
    """Nothing."""


@dataclass(frozen=True)
class Message:
    """One message, with its time in microseconds since the start of the stream."""

    kind: MessageKind
    payload: bytes
    t_us: int


@dataclass(frozen=True)
class Received:
    """A received message, and the number of messages of its counter missing before it."""

    message: Message
    missing: int = 0


class SequenceCounts:
    """One running number for each key, modulo `modulus`."""

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._next: defaultdict[Hashable, int] = defaultdict(int)

    def take(self, key: Hashable) -> int:
        """Return the next number of `key`."""
        number = self._next[key]
        self._next[key] = (number + 1) % self._modulus
        return number


class SequenceFollower:
    """Compares received sequence counts with the expected ones.

    A count less than half the modulus ahead means that the packets between are missing. A count behind (a repeat,
    packets out of order, a sender that restarted) is counted in `disordered`, and counting continues from it.

    Attributes
    ----------
    missing : packets that never arrived.
    disordered : packets with a count behind the expected one.
    """

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._expected: dict[Hashable, int] = {}
        self.missing = 0
        self.disordered = 0

    def follow(self, key: Hashable, number: int) -> int:
        """Process the count of a packet of `key`; return the number of packets missing before it."""
        ahead = (number - self._expected.get(key, number)) % self._modulus
        self._expected[key] = (number + 1) % self._modulus
        if ahead >= self._modulus // 2:
            self.disordered += 1
            return 0
        self.missing += ahead
        return ahead
