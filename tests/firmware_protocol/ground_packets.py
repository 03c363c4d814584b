"""Packets that the instrument's own code made, each with the values that went in: what every ground system must read.

The values are written here by hand, in the units of the definitions; the layouts are not asked.
"""

from dataclasses import dataclass

import numpy as np

from firmware_protocol.events import EDGE, EVENT
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.housekeeping import (
    EdgeCounts,
    EventCounts,
    Housekeeping,
    LinkCounts,
    Mode,
    TimeReport,
    TimeStatus,
)
from firmware_protocol.packets.profile import Profile
from firmware_protocol.packets.telecommands import (
    Failure,
    FailureCode,
    Ping,
    RequestHousekeeping,
    RequestId,
    SetBias,
    SetRateLimit,
    SetRegion,
    SetTick,
    SetTime,
    Stage,
    Start,
    Stop,
    Verification,
)
from firmware_protocol.telemetry.writing import BlockEncoder, BlockSettings

__all__ = ["COMMANDS", "SAMPLES", "Sample"]


@dataclass(frozen=True)
class Sample:
    """A packet, what it is called, the values of its body by name, and what it ends with."""

    name: str
    octets: bytes
    values: dict[str, int | float | str]
    rest: bytes = b""


T_US = 3_000_000_000_750_000  # 34.7 days and 0.75 s: seconds 0xB2D05E00
REQUEST = RequestId.parse(bytes.fromhex("1aa0c005"))
REQUEST_VALUES = {"request_packet_id": 0x1AA0, "request_sequence_control": 0xC005}
FAILED = Failure(FailureCode.ILLEGAL_DATA, "tick 7 us is none of 1, 10, 100, 1000")
EVENTS = np.array([(T_US, 345, 259, True), (T_US + 1000, 1, 2, False), (T_US + 70_000, 0, 0, True)], EVENT)
EDGES = np.array([(T_US, 2, 0, 7), (T_US + 123_456, 3, 0, 65_535)], EDGE)
EVENT_COUNTS = EventCounts(2**63 + 9, 2, 3, 4, 5, 6, 7, 8, 9, 2**40)
REPORT = Housekeeping(
    t_us=2**62 + 1,
    region=(10, 20, 300, 200),
    mode=Mode.STREAMING,
    time_status=TimeStatus.SET,
    offered_hz=4_000_000_000,
    sent_hz=900,
    temperature_centi_c=-1234,
    tick_us=100,
    rate_limit_hz=250_000,
    events=EVENT_COUNTS,
    edges=EdgeCounts(11, 12, 13, 14),
    link=LinkCounts(21, 22, 23, 65_536 + 24),
)
REPORT_VALUES = {
    "structure": 1,
    "mode": "STREAMING",
    "time_status": "SET",
    "reserved": 0,
    "own_time": 2**62 + 1,
    "offered_rate": 4_000_000_000,
    "sent_rate": 900,
    "temperature": -12.34,
    "tick": 100,
    "region_x": 10,
    "region_y": 20,
    "region_width": 300,
    "region_height": 200,
    "rate_limit": 250_000,
    "events_offered": 2**63 + 9,
    "events_sent": 2,
    "events_waiting": 3,
    "events_not_running": 4,
    "events_not_selected": 5,
    "events_over_rate": 6,
    "events_too_late": 7,
    "events_buffer_full": 8,
    "events_flushed": 9,
    "events_lost_on_link": 2**40,
    "edges_offered": 11,
    "edges_sent": 12,
    "edges_ignored": 13,
    "edges_dropped": 14,
    "commands_taken": 21,
    "commands_refused": 22,
    "frames_refused": 23,
    "commands_missing": 24,
}
BLOCK = BlockEncoder((346, 260), BlockSettings(mode="rows", tick_us=10)).encode(EVENTS, dropped=77)[0]
EDGE_BLOCK = BlockEncoder((346, 260)).encode_edges(EDGES)


def _block_values(mode, tick, count, dropped, crc8):
    """The header of a block; only its checksum is read from it."""
    return {
        "block_version": 1,
        "mode": mode,
        "tick_code": tick,
        "polarity": "EACH",
        "block_reserved": 0,
        "count": count,
        "t_base": T_US % 2**32,
        "dropped": dropped,
        "width_less_1": 345,
        "height_less_1": 259,
        "crc8": crc8,
    }


def _samples():
    say = Profile("ccsds")

    def packet(kind, payload=b""):
        return say.wrap(Message(kind, payload, T_US))

    def verification(stage, failure=None):
        return packet(MessageKind.VERIFICATION, Verification(stage, REQUEST, failure).encode())

    failed = {**REQUEST_VALUES, "failure_code": "ILLEGAL_DATA"}
    text = FAILED.text.encode()
    return [
        Sample("HOUSEKEEPING", packet(MessageKind.HOUSEKEEPING, REPORT.encode()), REPORT_VALUES),
        Sample(
            "EVENTS", packet(MessageKind.EVENTS, BLOCK), _block_values("ROWS", "US_10", 3, 77, BLOCK[13]), BLOCK[14:]
        ),
        Sample(
            "EDGES",
            packet(MessageKind.EDGES, EDGE_BLOCK),
            _block_values("EDGE", "US_1", 2, 0, EDGE_BLOCK[13]),
            EDGE_BLOCK[14:],
        ),
        Sample("VERIFICATION_ACCEPTED", verification(Stage.ACCEPTANCE), REQUEST_VALUES),
        Sample("VERIFICATION_COMPLETED", verification(Stage.COMPLETION), REQUEST_VALUES),
        Sample("VERIFICATION_NOT_ACCEPTED", verification(Stage.ACCEPTANCE, FAILED), failed, text),
        Sample("VERIFICATION_NOT_COMPLETED", verification(Stage.COMPLETION, FAILED), failed, text),
        Sample(
            "TIME",
            packet(MessageKind.TIME, TimeReport(1_500_000, TimeStatus.SET).encode()),
            {"now_p_field": 0x2F, "now_seconds": 1, "now_fraction": 0.5, "time_status": "SET"},
        ),
        Sample("PONG", packet(MessageKind.PONG), {}),
        Sample("PONG", packet(MessageKind.PONG), {}),
    ]


SAMPLES = _samples()
"""All are of time `T_US`."""


def _commands():
    tell = Profile("ccsds")
    return [
        Sample(type(command).__name__, tell.wrap_command(command), values)
        for command, values in (
            (Ping(), {}),
            (RequestHousekeeping(), {"structures": 1, "structure": 1}),
            (SetTime(2_000_000_250_000), {"now_seconds": 2_000_000, "now_fraction": 0.25}),
            (Start(), {}),
            (Stop(), {}),
            (SetTick(1000), {"tick_us": "US_1000"}),
            (SetRegion(1, 2, 300, 65_535), {"x": 1, "y": 2, "width": 300, "height": 65_535}),
            (SetRateLimit(4_000_000_000), {"events_per_s": 4_000_000_000}),
            (SetBias(12, 0x5B4F), {"bias": 12, "value": 0x5B4F}),
        )
    ]


COMMANDS = _commands()
"""Telecommands, with the values of their application data."""
