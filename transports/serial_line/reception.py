"""What a computer makes of an instrument's bytes: events, and what is missing. Knows no port and no clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from firmware_protocol.edges import Edges, empty_edges
from firmware_protocol.event_copies import join_events
from firmware_protocol.events import Events, empty_events
from firmware_protocol.packets.errors import PacketError
from firmware_protocol.packets.housekeeping import Housekeeping
from firmware_protocol.packets.message import Message, MessageKind
from firmware_protocol.packets.profile import Profile
from firmware_protocol.packets.telecommands import Telecommand
from firmware_protocol.packets.verification import RequestId, Verification
from firmware_protocol.telemetry import BlockEncoder, BlockError, BlockSettings, decode_block

__all__ = ["Arrival", "SerialReceiver"]


def _load_kernels() -> None:
    """Load the decoder's compiled code before a line waits for it: it takes a good part of a second."""
    for mode in ("rows", "bitmap", "flat"):
        block, _ = BlockEncoder((2, 2), BlockSettings(mode=mode)).encode(empty_events(2))
        decode_block(block)


@dataclass(frozen=True)
class Arrival:
    """What one piece of bytes brought: (n,) EVENT and (m,) EDGE in the camera's time, and words for people."""

    events: Events
    edges: Edges
    told: tuple[str, ...] = ()


class SerialReceiver:
    """Takes bytes, gives events; wraps telecommands and follows their answers.

    Attributes
    ----------
    housekeeping
        The newest report; None before the first.
    """

    def __init__(self, profile: Profile) -> None:
        self._profile = profile
        self._unwrapper = profile.unwrapper()
        self._counts: Counter[str] = Counter()
        self._asked: dict[RequestId, str] = {}
        self._began = self._lost = False
        self._damaged_at_start = 0
        self._damaged = 0
        self.housekeeping: Housekeeping | None = None
        _load_kernels()

    def wrap(self, command: Telecommand) -> bytes:
        """Return the bytes of a telecommand, whose answers will be told."""
        octets = self._profile.wrap_command(command)
        if self._profile.last_request is not None:
            self._asked[self._profile.last_request] = type(command).__name__
        self._counts["telecommands"] += 1
        return octets

    def push(self, data: bytes) -> Arrival:
        """Take the next bytes, any number of them."""
        received = self._unwrapper.push(data)
        self._follow(bool(received))
        events: list[Events] = []
        edges: list[Edges] = []
        told: list[str] = []
        for message in (each.message for each in received):
            self._counts[message.kind.value] += 1
            if message.kind in (MessageKind.EVENTS, MessageKind.EDGES):
                self._block(message, events, edges)
            else:
                told += self._answer(message)
        return Arrival(join_events(events), np.concatenate(edges) if edges else empty_edges(), tuple(told))

    @property
    def faults(self) -> int:
        """Things that a sound line never shows: damage after the first good frame, gaps, blocks that are wrong."""
        seen = self._unwrapper.counters
        wrong = self._counts["bad_blocks"] + self._counts["bad_answers"]
        return self._damaged - self._damaged_at_start + seen.missing + seen.disordered + wrong

    @property
    def counts(self) -> Mapping[str, int]:
        """Everything by name."""
        seen = self._unwrapper.counters
        reasons = seen.frames.refused + seen.refused
        return {
            "bytes": seen.frames.bytes_received,
            "bytes_skipped": seen.frames.bytes_skipped,
            "frames": seen.frames.frames,
            "messages_missing": seen.missing,
            "messages_disordered": seen.disordered,
            **{f"damaged: {reason}": count for reason, count in reasons.items()},
            **self._counts,
        }

    def _follow(self, good: bool) -> None:
        """Count how often the stream was lost and found again; what was damaged before the first frame is no fault."""
        seen = self._unwrapper.counters
        damaged = sum(seen.frames.refused.values()) + sum(seen.refused.values())
        self._lost |= self._began and damaged > self._damaged
        self._damaged = damaged
        if good and not self._began:
            self._began, self._damaged_at_start = True, damaged
        elif good and self._lost:
            self._lost = False
            self._counts["resynchronised"] += 1

    def _block(self, message: Message, events: list[Events], edges: list[Edges]) -> None:
        try:
            block = decode_block(message.payload, message.t_us)
        except BlockError:
            self._counts["bad_blocks"] += 1
            return
        self._counts["events_dropped" if message.kind is MessageKind.EVENTS else "edges_dropped"] += block.dropped
        events.append(block.events)
        edges.append(block.edges)

    def _answer(self, message: Message) -> list[str]:
        try:
            if message.kind is MessageKind.HOUSEKEEPING:
                self.housekeeping = Housekeeping.parse(message.payload)
                return []
            if message.kind is MessageKind.VERIFICATION:
                return [self._verified(Verification.parse(message.payload))]
        except PacketError:
            self._counts["bad_answers"] += 1
            return []
        return [message.kind.value]

    def _verified(self, verification: Verification) -> str:
        command = self._asked.get(verification.request, "a telecommand of somebody else")
        stage = verification.stage.name.lower()
        if verification.failure is None:
            return f"{command}: {stage} good"
        return f"{command}: {stage} failed: {verification.failure.text} (code {verification.failure.code.value})"
