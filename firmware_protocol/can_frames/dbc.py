"""The CAN identifiers of a camera, and a DBC file with the layouts of its frames, which most CAN tools read.

The file is generated from the table that the link uses, so both agree. Signals are in Intel order (`@1`), except
spacecraft time, which is big-endian (`@0`, start bit = most significant).

All identifiers of a CAN link are in one table, so that a project can change any of them. Defaults for node N:

    0x000      NMT orders of the master            0x180+N   events frames
    0x080      SYNC                                0x280+N   epoch frames
    0x080+N    EMCY                                0x380+N   marks: the camera's own trigger and exposure
    0x100      TIME                                0x400+N   edges on the camera's external input
    0x101      follow-up of a SYNC                 0x300+N   clock frames
                                                   0x480+N   telemetry (ISO-TP, from the camera)
    0x180      SCET of the master                  0x500+N   telecommands (ISO-TP, to the camera)
    0x700      heartbeat of the master             0x700+N   heartbeat

CANopen's predefined connection set, with the masters' objects of SpaceCAN, where the master is node 0.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from firmware_protocol.can_frames.canopen import NmtCommand, NodeState
from firmware_protocol.can_frames.raw_events import FD_CELLS, TICKS_US

_LAST_STANDARD = 0x7FF


@dataclass(frozen=True)
class Identifiers:
    """Identifiers (11 bits each) of the frames that a camera sends and receives on a CAN bus, all different.

    Attributes
    ----------
    nmt : commands of the network's master: start, stop.
    sync : the bus's SYNC.
    emcy : the camera's emergency messages.
    time : time of day, to the millisecond.
    follow_up : transmission time of a SYNC.
    scet : spacecraft time, to 60 ns.
    events : the camera's events frames.
    epoch : the camera's epoch frames, which belong to the events frames.
    clock : the camera's clock frames, with all bits of the time.
    marks : the camera's own trigger and exposure marks.
    edges : edges on the camera's external input, with raw frames.
    telemetry : ISO-TP messages of the camera.
    telecommand : ISO-TP messages to the camera.
    heartbeat : the camera's heartbeat.
    master_heartbeat : the master's heartbeat, which selects the bus in use.
    """

    nmt: int = 0x000
    sync: int = 0x080
    emcy: int = 0x0A2
    time: int = 0x100
    follow_up: int = 0x101
    scet: int = 0x180
    events: int = 0x1A2
    epoch: int = 0x2A2
    clock: int = 0x322
    marks: int = 0x3A2
    edges: int = 0x422
    telemetry: int = 0x4A2
    telecommand: int = 0x522
    heartbeat: int = 0x722
    master_heartbeat: int = 0x700

    def __post_init__(self) -> None:
        taken: dict[int, str] = {}
        for name, value in self.by_name.items():
            if not 0 <= value <= _LAST_STANDARD:
                raise ValueError(f"{name} must be 0 to {_LAST_STANDARD:#x} (11 bits), got {value:#x}")
            if value in taken:
                raise ValueError(f"{name} and {taken[value]} have the same identifier {value:#05x}; give each its own")
            taken[value] = name

    @classmethod
    def of_node(cls, node: int) -> Identifiers:
        """Return the defaults for a node, 1 to 127."""
        if not 1 <= node <= 127:
            raise ValueError(f"node must be 1 to 127, got {node}")
        return cls(
            emcy=0x080 + node,
            events=0x180 + node,
            epoch=0x280 + node,
            clock=0x300 + node,
            marks=0x380 + node,
            edges=0x400 + node,
            telemetry=0x480 + node,
            telecommand=0x500 + node,
            heartbeat=0x700 + node,
        )

    @property
    def by_name(self) -> dict[str, int]:
        """All identifiers by name."""
        return dataclasses.asdict(self)


Transport = Literal["raw", "isotp", "cfp"]
"""Transport of the instrument's messages."""

CAMERA = "CAMERA"
MASTER = "MASTER"
ANYONE = "Vector__XXX"

_RAW_ONLY = frozenset({"events", "epoch", "clock", "edges"})
_ABSENT: Mapping[str, frozenset[str]] = {
    "raw": frozenset(),
    "isotp": _RAW_ONLY,
    "cfp": _RAW_ONLY | {"telemetry", "telecommand"},
}
"""Messages that a link with this transport does not have."""
_FD_FRAMES = frozenset({"events", "telemetry", "telecommand"})
_CFP_COMMENT = "Events, edges, answers and telecommands are CSP packets, in frames of CFP 2 with extended identifiers"


@dataclass(frozen=True)
class Signal:
    """A number in a frame, as a DBC file describes it; `start` is its lowest bit, in big-endian ones its highest."""

    name: str
    start: int
    bits: int
    unit: str = ""
    factor: str = "1"
    big_endian: bool = False
    values: tuple[tuple[int, str], ...] = ()

    def line(self) -> str:
        """Return the signal's line of a DBC file."""
        order = 0 if self.big_endian else 1
        top = (1 << self.bits) - 1
        scaled = top if self.factor == "1" else float(self.factor) * top
        return (
            f" SG_ {self.name} : {self.start}|{self.bits}@{order}+ ({self.factor},0) [0|{scaled}] "
            f'"{self.unit}" {ANYONE}'
        )

    def choices(self) -> str:
        """Return the names of its values for a DBC file."""
        return " ".join(f'{value} "{text}"' for value, text in self.values)


@dataclass(frozen=True)
class CanMessage:
    """A kind of frame; `name` is the key of the identifier table."""

    name: str
    length: int
    sender: str
    comment: str
    signals: tuple[Signal, ...] = ()


def dbc_text(identifiers: Identifiers, *, fd: bool = False, transport: Transport = "raw") -> str:
    """Return the DBC file of a camera with these identifiers, in classic or in FD frames, for one transport."""
    messages = can_messages(fd=fd, transport=transport)
    ids = identifiers.by_name
    lines = ['VERSION ""', "", "NS_ :", "", "BS_:", "", f"BU_: {CAMERA} {MASTER}", ""]
    for m in messages:
        lines += [f"BO_ {ids[m.name]} {m.name}: {m.length} {m.sender}", *(s.line() for s in m.signals), ""]
    lines += [f'CM_ "{_CFP_COMMENT}";'] if transport == "cfp" else []
    lines += [f'CM_ BO_ {ids[m.name]} "{m.comment}";' for m in messages]
    if fd:
        lines += [
            'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","StandardCAN_FD","ExtendedCAN_FD";',
            'BA_DEF_DEF_ "VFrameFormat" "StandardCAN";',
            *(f'BA_ "VFrameFormat" BO_ {ids[m.name]} 2;' for m in messages if m.name in _FD_FRAMES),
        ]
    lines += [f"VAL_ {ids[m.name]} {s.name} {s.choices()} ;" for m in messages for s in m.signals if s.values]
    return "\n".join(lines) + "\n"


def can_messages(*, fd: bool = False, transport: Transport = "raw") -> list[CanMessage]:
    """Return the kinds of frames of a camera, in classic or in FD frames, for one transport."""
    orders = (Signal("command", 0, 8, values=_values(NmtCommand)), Signal("node", 8, 8))
    overflow = (Signal("code", 0, 16), Signal("register", 16, 8), Signal("dropped", 24, 32, "events"))
    spacecraft = (
        Signal("seconds", 7, 32, "s", big_endian=True),
        Signal("fraction", 39, 24, "s", "5.960464477539063e-08", big_endian=True),
    )
    left = (Signal("counter", 0, 8), Signal("sent", 8, 56, "ns"))
    epoch = (
        Signal("t", 0, 30, "ticks"),
        Signal("tick", 30, 2, values=tuple(enumerate(f"{us} us" for us in TICKS_US))),
        Signal("sent", 32, 16, "events"),
        Signal("dropped", 48, 16, "events"),
    )
    marks = (Signal("t", 0, 32, "us"), Signal("kind", 32, 8), Signal("channel", 40, 8), Signal("seq", 48, 16))
    state = (Signal("state", 0, 7, values=_values(NodeState)),)
    messages = [
        CanMessage("nmt", 2, MASTER, "Commands to the camera", orders),
        CanMessage("sync", 1, MASTER, "Trigger and time base; counter is optional", (Signal("counter", 0, 8),)),
        CanMessage("emcy", 8, CAMERA, "8110: events were dropped; 0000: no more", overflow),
        CanMessage("time", 6, MASTER, "Since 1984-01-01", (Signal("ms", 0, 28, "ms"), Signal("days", 32, 16, "d"))),
        CanMessage("scet", 7, MASTER, "Spacecraft time, CUC 4+3", spacecraft),
        CanMessage("follow_up", 8, CAMERA, "Transmission time of the SYNC with this counter", left),
        _fd_events() if fd else _events(),
        CanMessage("epoch", 8, CAMERA, "Upper bits of the events' times, and counts of events", epoch),
        CanMessage("clock", 8, CAMERA, "All bits of the events' time", (Signal("t", 0, 64, "us"),)),
        CanMessage("marks", 8, CAMERA, "The camera's own trigger and exposure marks", marks),
        CanMessage("edges", 8, CAMERA, "Edges on the camera's external input", marks),
        CanMessage("telemetry", 64 if fd else 8, CAMERA, "ISO-TP", (Signal("pci", 0, 8),)),
        CanMessage("telecommand", 64 if fd else 8, MASTER, "ISO-TP", (Signal("pci", 0, 8),)),
        CanMessage("heartbeat", 1, CAMERA, "State of the camera", state),
        CanMessage("master_heartbeat", 1, MASTER, "Selects the bus in use", state),
    ]
    return [message for message in messages if message.name not in _ABSENT[transport]]


def _values(names: Iterable[NmtCommand] | Iterable[NodeState]) -> tuple[tuple[int, str], ...]:
    return tuple((int(member), member.name.lower().replace("_", " ")) for member in names)


def _events() -> CanMessage:
    pixels = [
        Signal(f"{name}{i}", 26 + 19 * i + at, bits, unit)
        for i in (0, 1)
        for name, at, bits, unit in (("x", 0, 9, "px"), ("y", 9, 9, "px"), ("on", 18, 1, ""))
    ]
    head = (
        Signal("t", 0, 16, "ticks"),
        Signal("seq", 16, 3),
        Signal("dt", 19, 7, "ticks", values=((127, "no second event"),)),
    )
    return CanMessage("events", 8, CAMERA, "One or two events", (*head, *pixels))


def _fd_events() -> CanMessage:
    head = (
        Signal("t", 0, 32, "ticks"),
        Signal("seq", 32, 8),
        Signal("n", 40, 8, "cells"),
        Signal("dropped", 48, 8, "events"),
    )
    cells = [
        Signal(f"{name}{i}", 56 + 24 * i + at, bits, unit)
        for i in range(FD_CELLS)
        for name, at, bits, unit in (("x", 0, 9, "px"), ("y", 9, 9, "px"), ("on", 18, 1, ""), ("dt", 19, 5, "ticks"))
    ]
    return CanMessage("events", 64, CAMERA, "Up to 19 events; dt = 31: no event, ticks to add", (*head, *cells))
