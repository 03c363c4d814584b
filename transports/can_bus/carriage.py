"""Transport of an instrument's messages in CAN frames: raw events, or whole messages by ISO-TP or in CSP packets.

The endpoint calls `next_frame` when the bus has room, and `left` when the bus has accepted the frame. With the last
frame of a message `left` returns the message; the endpoint then calls `delivered` or `lost` with the outcome. Each
frame is returned once: the endpoint stores a frame that the bus refused.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.raw_events import FD_CELLS, pack_marks
from firmware_protocol.can_frames.raw_stream import Packed, RawSender, RawSettings
from firmware_protocol.can_frames.transport import (
    CfpReceiver,
    IsoTpFailure,
    IsoTpReceiver,
    IsoTpSender,
    IsoTpSettings,
    cfp_frames,
)
from firmware_protocol.device.items import Items
from firmware_protocol.events import Edges, copy_events, empty_edges
from firmware_protocol.instrument.instrument import Instrument, Outgoing
from firmware_protocol.packets.addresses import Addresses, Received
from firmware_protocol.packets.profile import CommandUnwrapper, Profile
from transports.can_bus.kind import CanLink
from transports.faults.bus import Tracker
from transports.link.deliveries import Deliveries


class FrameSource(ABC):
    """Source of the frames of one kind, in order. `label` names the kind in fault counts.

    `tracker` follows which messages arrive while faults may hit frames; set and removed between two messages.
    """

    label = "frames"

    def __init__(self, instrument: Instrument, deliveries: Deliveries) -> None:
        self._instrument = instrument
        self._deliveries = deliveries
        self._outgoing: Outgoing | None = None
        self._frames: deque[Any] = deque()  # the remaining ones of the message in progress
        self.faults: Counter[str] = Counter()
        self.tracker: Tracker | None = None

    @property
    def between(self) -> bool:
        """True when no message is in progress."""
        return self._outgoing is None

    @property
    def load(self) -> Items:
        """Events and edges in the last frame returned."""
        return Items()

    def reader(self) -> Callable[[Frame], list[Received]] | None:
        """Return a function that decodes frames as the receiver does; None for frames that stand alone."""
        return None

    @abstractmethod
    def next_frame(self, now_ns: int) -> Frame | None:
        """Return the next frame that may be sent now; None if there is none."""

    def left(self) -> Outgoing | None:
        """Record that the bus accepted the last frame; return the message that it ends, unless a tracker follows it."""
        return None if self._frames else self._finished()

    def delivered(self, outgoing: Outgoing) -> None:
        """Record that all frames of a message were on the bus."""
        self._instrument.sent(outgoing)
        self._deliveries.add_items(outgoing)

    def lost(self, outgoing: Outgoing) -> None:
        """Record that the last frames of a message never reached the bus."""
        self._instrument.lost(outgoing)

    def cut(self) -> Outgoing | None:
        """Split off the sent part of a message in progress, if that part stands alone and no tracker follows it."""
        return None

    def drop(self) -> None:
        """Discard the message in progress, because the bus is lost."""
        self._frames.clear()
        if self._outgoing is not None:
            self._instrument.lost(self._outgoing)
            self._outgoing = None
            if self.tracker is not None:
                self.tracker.dropped()

    def receive(self, frame: Frame, now_ns: int) -> Frame | None:
        """Process a frame of another node; return the frame to send at once in answer, if any."""
        return None

    def _finished(self) -> Outgoing | None:
        outgoing, self._outgoing = self._outgoing, None
        if outgoing is None or self.tracker is None:
            return outgoing
        self._instrument.sent(outgoing)
        self.tracker.left(outgoing)
        return None


class _RawEvents(FrameSource):
    """Events in frames that stand alone; `sender` encodes the events, clock and epoch frames."""

    _frames: deque[Packed]

    def __init__(self, instrument: Instrument, deliveries: Deliveries, settings: RawSettings) -> None:
        super().__init__(instrument, deliveries)
        self._events_a_time = 4 * (FD_CELLS if settings.fd else 2)  # few: their fate is unknown when a bus is lost
        self._tick_us = instrument.tick_us
        self.sender = RawSender(settings)
        self._load = Items()
        self._given = self._taken = 0  # events in the last frame returned; events of this message on the bus
        self._epoch_us = 0

    @property
    def load(self) -> Items:
        return self._load

    @property
    def halfway(self) -> bool:
        """True while frames of a group wait of which the first has been returned."""
        return bool(self._frames)

    def next_frame(self, now_ns: int) -> Frame | None:
        if not self._frames and self._outgoing is None:
            self._pack()
        if not self._frames:
            self._load = Items()
            return None
        packed = self._frames.popleft()
        self._given = len(packed.events)
        if self.tracker is not None:
            self._load = Items(packed.events, epoch_us=self._epoch_us)
        return packed.frame

    def left(self) -> Outgoing | None:
        self._taken += self._given
        if self._frames:
            return None
        self._given = self._taken = 0
        return self._finished()

    def cut(self) -> Outgoing | None:
        outgoing, taken = self._outgoing, self._taken
        if outgoing is None or self.tracker is not None:
            return None
        self._outgoing = replace(outgoing, events=outgoing.events[taken:])
        self._taken = 0
        return replace(outgoing, events=outgoing.events[:taken])

    def drop(self) -> None:
        self._given = self._taken = 0
        self.sender.forget()
        super().drop()

    def _pack(self) -> None:
        if self._instrument.tick_us != self._tick_us:
            self._tick_us = self._instrument.tick_us
            self.sender.set_tick(self._tick_us)
        outgoing = self._instrument.next_events(self._events_a_time)
        if outgoing is None:
            self._frames += self.sender.epoch(self._instrument.own_us, self._instrument.counters.dropped_for_room)
            return
        own_events = copy_events(outgoing.events)
        self._epoch_us = outgoing.epoch_us
        epoch = np.uint64(outgoing.epoch_us % (1 << 64))
        own_events["t"] -= epoch
        self._frames += self.sender.pack(own_events, self._instrument.counters.dropped_for_room)
        own_events["t"] = own_events["t"] // np.uint64(self._tick_us) * np.uint64(self._tick_us) + epoch
        self._outgoing = replace(outgoing, events=own_events)


class _RawEdges(FrameSource):
    """Edges of the external input, one frame each.

    Edges are sent between two groups of event frames: one sender makes the clock and epoch frames of both, and they
    must leave in the order in which it made them.
    """

    _frames: deque[tuple[Frame, Edges]]

    def __init__(self, instrument: Instrument, deliveries: Deliveries, events: _RawEvents, identifier: int) -> None:
        super().__init__(instrument, deliveries)
        self._events = events
        self._identifier = identifier
        self._load = Items()

    def next_frame(self, now_ns: int) -> Frame | None:
        if self._outgoing is None:
            self._outgoing = None if self._events.halfway else self._instrument.next_edges()
            if self._outgoing is None:
                return None
            self._pack(self._outgoing)
        if not self._frames:
            return None
        frame, edges = self._frames.popleft()
        self._load = Items(edges=edges, epoch_us=self._outgoing.epoch_us)
        return frame

    @property
    def load(self) -> Items:
        return Items() if self._outgoing is None else self._load

    def _pack(self, outgoing: Outgoing) -> None:
        own_edges = outgoing.edges.copy()
        own_edges["t"] -= np.uint64(outgoing.epoch_us % (1 << 64))
        for at, data in enumerate(pack_marks(own_edges)):
            before = self._events.sender.time_frames(int(own_edges["t"][at]))
            self._frames += [(packed.frame, empty_edges()) for packed in before]
            self._frames.append((Frame(self._identifier, data), outgoing.edges[at : at + 1]))

    def drop(self) -> None:
        self._events.sender.forget()
        super().drop()


class _IsoTpTransport(FrameSource):
    """Messages by ISO-TP, with telecommands in the other direction; `with_all` includes events and edges."""

    label = "ISO-TP"

    def __init__(
        self, instrument: Instrument, deliveries: Deliveries, settings: IsoTpSettings, *, with_all: bool
    ) -> None:
        super().__init__(instrument, deliveries)
        self._settings = settings
        self._with_all = with_all
        self._profile = Profile("ccsds")
        self._commands = self._profile.command_unwrapper()
        self._sender = IsoTpSender(settings)
        self._receiver = IsoTpReceiver(settings)
        self.faults = self._receiver.faults

    def next_frame(self, now_ns: int) -> Frame | None:
        if self._outgoing is None:
            self._outgoing = self._instrument.next_message(events=self._with_all, edges=self._with_all)
            if self._outgoing is None:
                return None
            self._sender.start(self._profile.wrap(self._outgoing.message))
        try:
            return self._sender.next_frame(now_ns)
        except IsoTpFailure:
            self.faults["messages given up"] += 1
            self.drop()
            return None

    def left(self) -> Outgoing | None:
        return None if self._sender.busy else self._finished()

    def drop(self) -> None:
        self._sender.abort()
        super().drop()

    def reader(self) -> Callable[[Frame], list[Received]]:
        peer = replace(self._settings, send=self._settings.receive, receive=self._settings.send)
        receiver, unwrapper = IsoTpReceiver(peer), Profile("ccsds").unwrapper()
        return lambda frame: unwrapper.push(receiver.push(frame, 0) or b"")

    def receive(self, frame: Frame, now_ns: int) -> Frame | None:
        if not self._settings.is_ours(frame):
            return None
        if frame.data and frame.data[0] >> 4 == 3:
            try:
                self._sender.flow_control(frame, now_ns)
            except IsoTpFailure:
                self.faults["messages refused by the peer"] += 1
                self.drop()
            return None
        packet = self._receiver.push(frame, now_ns)
        if packet is not None:
            _obey(self._instrument, self._commands, packet)
        return self._receiver.reply


class _CfpTransport(FrameSource):
    """Messages in CSP packets, fragmented by CFP 2, with telecommands in the other direction."""

    label = "CFP"
    _frames: deque[Frame]

    def __init__(self, instrument: Instrument, deliveries: Deliveries, parameters: CanLink) -> None:
        super().__init__(instrument, deliveries)
        self._address, self._peer = parameters.csp_address, parameters.csp_peer
        self._profile = Profile("csp", Addresses(csp_node=parameters.csp_address, csp_peer=parameters.csp_peer))
        self._commands = self._profile.command_unwrapper()
        self._receiver = CfpReceiver(parameters.csp_address)
        self._packets = 0
        self.faults = self._receiver.faults

    def next_frame(self, now_ns: int) -> Frame | None:
        if self._outgoing is None:
            self._outgoing = self._instrument.next_message()
            if self._outgoing is None:
                return None
            packet = self._profile.wrap(self._outgoing.message)
            self._frames += cfp_frames(packet, self._address, self._packets)
            self._packets += 1
        return self._frames.popleft() if self._frames else None

    def reader(self) -> Callable[[Frame], list[Received]]:
        addresses = Addresses(csp_node=self._address, csp_peer=self._peer)
        receiver, unwrapper = CfpReceiver(self._peer), Profile("csp", addresses).unwrapper()
        return lambda frame: unwrapper.push(receiver.push(frame, 0) or b"")

    def receive(self, frame: Frame, now_ns: int) -> Frame | None:
        packet = self._receiver.push(frame, now_ns)
        if packet is not None:
            _obey(self._instrument, self._commands, packet)
        return None


def sources(instrument: Instrument, deliveries: Deliveries, parameters: CanLink) -> list[FrameSource]:
    """Return the frame sources of a link, the most urgent first."""
    if parameters.carriage == "cfp":
        return [_CfpTransport(instrument, deliveries, parameters)]
    if parameters.carriage == "isotp":
        return [_IsoTpTransport(instrument, deliveries, parameters.isotp, with_all=True)]
    events = _RawEvents(instrument, deliveries, parameters.raw(instrument.tick_us))
    return [
        _RawEdges(instrument, deliveries, events, parameters.identifiers.edges),
        _IsoTpTransport(instrument, deliveries, parameters.isotp, with_all=False),
        events,
    ]


def _obey(instrument: Instrument, commands: CommandUnwrapper, packet: bytes) -> None:
    for received in commands.push(packet):
        instrument.command(received)
