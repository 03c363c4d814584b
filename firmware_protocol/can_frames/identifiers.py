"""All identifiers of a CAN link in one table, so that a project can move any of them. Defaults for node N:

    0x000      NMT orders of the master            0x180+N   events frames
    0x080      SYNC                                0x280+N   epoch frames
    0x080+N    EMCY                                0x380+N   marks: the camera's own trigger and exposure
    0x100      TIME                                0x400+N   edges on the camera's external input
    0x101      follow-up of a SYNC                 0x300+N   clock frames
                                                   0x480+N   telemetry (ISO-TP, ours)
    0x180      SCET of the master                  0x500+N   telecommands (ISO-TP, the peer's)
    0x700      heartbeat of the master             0x700+N   heartbeat

CANopen's predefined connection set, with the masters' objects of SpaceCAN, where the master is node 0.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

__all__ = ["Identifiers"]

_LAST_STANDARD = 0x7FF


@dataclass(frozen=True)
class Identifiers:
    """Identifiers (11 bits each) of what a camera sends and hears on a CAN bus. Two that are equal are refused.

    Attributes
    ----------
    nmt
        Orders of the network's master: start, stop.
    sync
        The bus's SYNC.
    emcy
        Our emergency messages.
    time
        Time of day, to the millisecond.
    follow_up
        When a SYNC really left.
    scet
        Spacecraft time, to 60 ns.
    events
        Our events frames.
    epoch
        Our epoch frames, which belong to the events frames.
    clock
        Our clock frames, with all bits of the time.
    marks
        Our own trigger and exposure marks.
    edges
        Edges on our external input, with raw frames.
    telemetry
        Our ISO-TP messages.
    telecommand
        ISO-TP messages to us.
    heartbeat
        Our heartbeat.
    master_heartbeat
        The master's heartbeat, which says which bus is in use.
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
        """All of them."""
        return dataclasses.asdict(self)
