"""The computer's side of a CAN link: frames in, events and a report out. No bus: frames are pushed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np

from firmware_protocol.can_frames.canopen import ObjectError
from firmware_protocol.can_frames.cfp import CfpReceiver
from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.isotp import IsoTpReceiver
from firmware_protocol.can_frames.marks import unpack_mark
from firmware_protocol.can_frames.raw_stream import RawReceiver
from firmware_protocol.edges import Edges
from firmware_protocol.events import Events, empty_events
from firmware_protocol.packets.addresses import Addresses
from firmware_protocol.packets.message import MessageKind, Received
from firmware_protocol.packets.profile import Profile, Unwrapper
from firmware_protocol.telemetry import BlockError, decode_block
from transports.can_bus.parameters import CanParameters

__all__ = ["CanReceiver"]


class CanReceiver:
    """Decodes what a camera says with these parameters, whichever carriage it uses.

    Attributes
    ----------
    edges
        Received so far, each (1,) or more.
    answer
        The frame to send at once after the last `push`, None for none: flow control.
    """

    def __init__(self, parameters: CanParameters) -> None:
        ids = parameters.identifiers
        self._names = {value: name for name, value in ids.by_name.items()}
        self._edge_ids = (ids.edges, ids.marks)
        self._raw = RawReceiver(ids.events, ids.epoch)
        self._isotp = IsoTpReceiver(parameters.peer_isotp)
        self._cfp = CfpReceiver(parameters.csp_peer)
        self._from_isotp = Profile("ccsds").unwrapper()
        self._from_cfp = Profile(
            "csp", Addresses(csp_node=parameters.csp_address, csp_peer=parameters.csp_peer)
        ).unwrapper()
        self._heard: Counter[str] = Counter()
        self._events = self._dropped = self._missing = self._bad_blocks = 0
        self._now_us = 0
        self.edges: list[Edges] = []
        self.answer: Frame | None = None

    def push(self, frame: Frame, now_ns: int) -> Events:
        """Take a frame; return the events that it completes, shape (n,), in the camera's time."""
        self._heard["error frame" if frame.error else self._name(frame)] += 1
        events = self._raw.push(frame)
        if frame.identifier in self._edge_ids and not frame.extended:
            self._take_edge(frame)
        packet = self._isotp.push(frame, now_ns)
        self.answer = self._isotp.reply
        if packet is not None:
            events = self._open(self._from_isotp, packet)
        packet = self._cfp.push(frame, now_ns)
        if packet is not None:
            events = self._open(self._from_cfp, packet)
        if len(events):
            self._events += len(events)
            self._now_us = int(events["t"][-1])
        return events

    @property
    def counts(self) -> Mapping[str, int]:
        """What has come, what is missing, and what was wrong, by name; only what is not zero."""
        raw = self._raw.counters
        told = {
            **{f"frames: {name}": n for name, n in self._heard.items()},
            "events lost": raw.lost,
            "events dropped by the camera": raw.dropped + self._dropped,
            "gaps in raw frames": raw.gaps,
            "raw frames repeated": raw.repeated,
            "raw frames before an epoch": raw.before_epoch,
            "raw frames malformed": raw.malformed,
            "packets missing": self._missing,
            "packets refused": sum(
                sum(u.counters.refused.values()) + sum(u.counters.frames.refused.values())
                for u in (self._from_isotp, self._from_cfp)
            ),
            "blocks refused": self._bad_blocks,
            **{f"ISO-TP {name}": n for name, n in self._isotp.faults.items()},
            **{f"CFP {name}": n for name, n in self._cfp.faults.items()},
        }
        return {name: n for name, n in told.items() if n}

    @property
    def faults(self) -> int:
        """Things that a sound link never shows; a receiver that joins late is no fault."""
        raw = self._raw.counters
        cut = sum(n for name, n in self._isotp.faults.items() if name != "without a beginning")
        cut += sum(n for name, n in self._cfp.faults.items() if name != "without a beginning")
        return raw.lost + raw.gaps + raw.repeated + raw.malformed + self._missing + self._bad_blocks + cut

    def _take_edge(self, frame: Frame) -> None:
        try:
            self.edges.append(unpack_mark(frame.data, self._raw.now_us or 0))
        except ObjectError:
            self._heard["edge frames malformed"] += 1

    def _name(self, frame: Frame) -> str:
        return "CFP" if frame.extended else self._names.get(frame.identifier, f"{frame.identifier:03X}")

    def _open(self, unwrapper: Unwrapper, packet: bytes) -> Events:
        parts = [self._message(received) for received in unwrapper.push(packet)]
        return np.concatenate(parts) if parts else empty_events()

    def _message(self, received: Received) -> Events:
        self._missing += received.missing
        message = received.message
        self._heard[f"message {message.kind.name.lower()}"] += 1
        if message.kind not in (MessageKind.EVENTS, MessageKind.EDGES):
            return empty_events()
        try:
            block = decode_block(message.payload, message.t_us)
        except BlockError:
            self._bad_blocks += 1
            return empty_events()
        self._dropped += block.dropped if message.kind is MessageKind.EVENTS else 0
        if len(block.edges):
            self.edges.append(block.edges)
        return block.events
