"""Content of every packet of the instrument, for the writers of definitions, from the code's own layouts.

A packet is its primary header, its secondary header, its body (fields of fixed width), its tail (the part of varying
length), and the error control.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Literal

from firmware_protocol.framing import DEFAULT_MAX_PAYLOAD
from firmware_protocol.packets.addresses import DEFAULT_ADDRESSES, Addresses, MessageKind
from firmware_protocol.packets.ccsds import ERROR_CONTROL, PRIMARY_HEADER, TC_HEADER, TM_HEADER, Acknowledge, PacketType
from firmware_protocol.packets.codec import MESSAGE_TYPES, SCIENCE, VERIFICATION_SERVICE
from firmware_protocol.packets.housekeeping import HOUSEKEEPING_LAYOUT, TIME_LAYOUT
from firmware_protocol.packets.telecommands import FAILURE_LAYOUT, LONGEST_TEXT, REQUEST_LAYOUT, TELECOMMANDS, Stage
from firmware_protocol.telemetry.layout import EDGE_LAYOUT, HEADER_LAYOUT
from firmware_protocol.wire_layout import Field, Layout

_NOTHING = Layout()


@dataclass(frozen=True)
class Tail:
    """The part of a packet whose length varies, up to the error control.

    Attributes
    ----------
    longest, shortest : its greatest and least length, octets.
    records : layout of each of its records; None if it is octets or text.
    """

    name: str
    meaning: str
    longest: int
    shortest: int = 0
    kind: Literal["octets", "text", "records"] = "octets"
    records: Layout | None = None


_NO_TAIL = Tail("", "", 0)


@dataclass(frozen=True)
class Placed:
    """A field in its packet.

    Attributes
    ----------
    at : bits from the beginning of the packet to the first bit of the field.
    identifies : its only value in this kind of packet; None if it varies.
    """

    field: Field
    at: int
    identifies: int | None = None

    @property
    def preset(self) -> int:
        """Default value: all acknowledgements are requested, all else is the lowest value."""
        return self.identifies or (int(Acknowledge.ALL) if self.field.name == "acknowledge" else 0)


@dataclass(frozen=True)
class Packet:
    """One kind of packet."""

    name: str
    meaning: str
    type: PacketType
    apid: int
    service: int
    subtype: int
    body: Layout = _NOTHING
    tail: Tail | None = None

    @property
    def is_command(self) -> bool:
        """True if it is a telecommand."""
        return self.type is PacketType.TELECOMMAND

    @property
    def header(self) -> Layout:
        """Both headers."""
        return PRIMARY_HEADER + (TC_HEADER if self.is_command else TM_HEADER)

    @property
    def before_tail(self) -> int:
        """Octets before the part of varying length, or before the error control."""
        return self.header.octets + self.body.octets

    @property
    def lengths(self) -> tuple[int, int]:
        """Least and greatest number of octets."""
        fixed, tail = self.before_tail + ERROR_CONTROL.octets, self.tail or _NO_TAIL
        return fixed + tail.shortest, fixed + tail.longest

    @property
    def fields(self) -> tuple[Placed, ...]:
        """The fields of headers and body."""
        fields = (self.header + self.body).fields
        places = accumulate((field.bits for field in fields), initial=0)
        identifying = {"type": self.type, "apid": self.apid, "service": self.service, "subtype": self.subtype}
        identifying |= {"secondary_header": 1, "sequence_flags": 3}
        values = (identifying.get(field.name, field.fixed) for field in fields)
        return tuple(
            Placed(field, at, None if value is None else int(value))
            for field, at, value in zip(fields, places, values, strict=False)
        )

    @property
    def arguments(self) -> tuple[Placed, ...]:
        """The fields of the body."""
        return tuple(placed for placed in self.fields if placed.at >= self.header.bits)


def instrument_packets(addresses: Addresses = DEFAULT_ADDRESSES) -> tuple[Packet, ...]:
    """Return all messages of an instrument, then all its telecommands."""
    return (*_messages(addresses), *_verifications(addresses), *_commands(addresses))


def _messages(addresses: Addresses) -> Iterator[Packet]:
    block = DEFAULT_MAX_PAYLOAD - HEADER_LAYOUT.octets
    parts: dict[MessageKind, tuple[str, Layout, Tail | None]] = {
        MessageKind.EVENTS: (
            "One block of events; the packet's time is that of the first one",
            HEADER_LAYOUT,
            Tail("payload", "coded events: docs/packets.md", block),
        ),
        MessageKind.EDGES: (
            "One block of edges of the external input; the packet's time is that of the first one",
            HEADER_LAYOUT,
            Tail("edges", "records of edges", block, EDGE_LAYOUT.octets, "records", EDGE_LAYOUT),
        ),
        MessageKind.HOUSEKEEPING: ("State of the instrument", HOUSEKEEPING_LAYOUT, None),
        MessageKind.TIME: ("The instrument's time", TIME_LAYOUT, None),
        MessageKind.PONG: ("Answer to a ping", _NOTHING, None),
    }
    for kind, (meaning, body, tail) in parts.items():
        apid = addresses.science_apid if kind in SCIENCE else addresses.apid
        yield Packet(kind.name, meaning, PacketType.TELEMETRY, apid, *MESSAGE_TYPES[kind], body, tail)


def _verifications(addresses: Addresses) -> Iterator[Packet]:
    text = Tail("failure_text", "description of the failure", LONGEST_TEXT, kind="text")
    reports: Sequence[tuple[str, str, int, Layout, Tail | None]] = (
        ("ACCEPTED", "A telecommand was accepted", Stage.ACCEPTANCE, REQUEST_LAYOUT, None),
        ("NOT_ACCEPTED", "A telecommand was not accepted", Stage.ACCEPTANCE + 1, REQUEST_LAYOUT + FAILURE_LAYOUT, text),
        ("COMPLETED", "A telecommand was completed", Stage.COMPLETION, REQUEST_LAYOUT, None),
        ("NOT_COMPLETED", "A telecommand failed", Stage.COMPLETION + 1, REQUEST_LAYOUT + FAILURE_LAYOUT, text),
    )
    for name, meaning, subtype, body, tail in reports:
        yield Packet(
            f"VERIFICATION_{name}",
            meaning,
            PacketType.TELEMETRY,
            addresses.apid,
            VERIFICATION_SERVICE,
            int(subtype),
            body,
            tail,
        )


def _commands(addresses: Addresses) -> Iterator[Packet]:
    for (service, subtype), kind in TELECOMMANDS.items():
        meaning = (inspect.getdoc(kind) or "").rstrip(".")
        yield Packet(kind.__name__, meaning, PacketType.TELECOMMAND, addresses.apid, service, subtype, kind.LAYOUT)
