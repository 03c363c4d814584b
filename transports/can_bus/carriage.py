"""How what an instrument says gets into frames: raw events, or whole messages by ISO-TP or in CSP packets.

A source gives its next frame when the bus has room, and is told when the bus has taken it. With the last frame of a
message it gives back the message, and is told by `delivered` or `lost` what became of it. Frames are given once: the
endpoint keeps one that the bus did not take.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.raw_events import pack_marks
from firmware_protocol.can_frames.raw_stream import Packed, RawSender
from firmware_protocol.can_frames.transport import (
    CfpReceiver,
    IsoTpFailure,
    IsoTpReceiver,
    IsoTpSender,
    IsoTpSettings,
    cfp_frames,
)
from firmware_protocol.events import Edges, copy_events, empty_edges, empty_events
from firmware_protocol.instrument.instrument import Instrument, Outgoing
from firmware_protocol.packets.addresses import Addresses, Received
from firmware_protocol.packets.profile import CommandUnwrapper, Profile
from transports.can_bus.kind import CanLink
from transports.faults.tracker import Load, Tracker
from transports.link.deliveries import Deliveries

__all__ = ["CfpMail", "FrameSource", "IsoTpMail", "RawEdges", "RawEvents", "sources"]

_RAW_EVENTS_A_TIME = 8  # so that only so few have an uncertain fate when a bus goes away


class FrameSource(ABC):
    """Frames of one kind, in order. `label` names the kind where its faults are told.

    Attributes
    ----------
    tracker
        Follows what arrives while faults may hit frames; set and taken away between two messages.
    """

    label = "frames"

    def __init__(self, instrument: Instrument, deliveries: Deliveries) -> None:
        self._instrument = instrument
        self._deliveries = deliveries
        self._outgoing: Outgoing | None = None
        self.faults: Counter[str] = Counter()
        self.tracker: Tracker | None = None

    @property
    def between(self) -> bool:
        """True when no message is under way."""
        return self._outgoing is None

    @property
    def load(self) -> Load:
        """What the frame given last carries by itself."""
        return Load.nothing()

    def reader(self) -> Callable[[Frame], list[Received]] | None:
        """Return what makes messages of frames, as the other side does; None where frames stand alone."""
        return None

    @abstractmethod
    def next_frame(self, now_ns: int) -> Frame | None:
        """Return the next frame if there is one that may go now."""

    @abstractmethod
    def left(self) -> Outgoing | None:
        """Say that the bus took the frame given last; return the message that it ends, unless a tracker follows it."""

    def delivered(self, outgoing: Outgoing) -> None:
        """Say that all frames of a message were on the bus."""
        self._instrument.sent(outgoing)
        self._deliveries.add(outgoing.events, outgoing.epoch_us, outgoing.edges)

    def lost(self, outgoing: Outgoing) -> None:
        """Say that the last frames of a message never were on the bus."""
        self._instrument.lost(outgoing)

    def cut(self) -> Outgoing | None:
        """Cut off what the bus has taken of a message under way, where that stands by itself and is not watched."""
        return None

    def drop(self) -> None:
        """Forget the message under way: the bus is gone."""
        if self._outgoing is not None:
            self._instrument.lost(self._outgoing)
            self._outgoing = None
            if self.tracker is not None:
                self.tracker.dropped()

    def hear(self, frame: Frame, now_ns: int) -> Frame | None:
        """Take a frame of another node; return what has to be answered at once."""
        return None

    def _finished(self) -> Outgoing | None:
        outgoing, self._outgoing = self._outgoing, None
        if outgoing is None or self.tracker is None:
            return outgoing
        self._instrument.sent(outgoing)
        self.tracker.left(outgoing)
        return None


class RawEvents(FrameSource):
    """Events in frames that stand alone.

    Attributes
    ----------
    sender
        Makes them, and the clock and epoch frames.
    """

    def __init__(self, instrument: Instrument, deliveries: Deliveries, sender: RawSender) -> None:
        super().__init__(instrument, deliveries)
        self._tick_us = instrument.tick_us
        self.sender = sender
        self._frames: deque[Packed] = deque()
        self._load = Load.nothing()
        self._given = self._taken = 0  # events in the frame given last; in those of this message that the bus has
        self._epoch_us = 0

    @property
    def load(self) -> Load:
        """See `FrameSource.load`."""
        return self._load

    @property
    def halfway(self) -> bool:
        """True while frames wait that were made together with one that has been given."""
        return bool(self._frames)

    def next_frame(self, now_ns: int) -> Frame | None:
        """See `FrameSource.next_frame`."""
        if not self._frames and self._outgoing is None:
            self._pack()
        if not self._frames:
            self._load = Load.nothing()
            return None
        packed = self._frames.popleft()
        self._given = len(packed.events)
        if self.tracker is not None:
            self._load = Load(packed.events, empty_edges(), self._epoch_us)
        return packed.frame

    def left(self) -> Outgoing | None:
        """See `FrameSource.left`."""
        self._taken += self._given
        if self._frames:
            return None
        self._given = self._taken = 0
        return self._finished()

    def cut(self) -> Outgoing | None:
        """See `FrameSource.cut`."""
        outgoing, taken = self._outgoing, self._taken
        if outgoing is None or self.tracker is not None:
            return None
        self._outgoing = replace(outgoing, events=outgoing.events[taken:])
        self._taken = 0
        return replace(outgoing, events=outgoing.events[:taken])

    def drop(self) -> None:
        """See `FrameSource.drop`."""
        self._frames.clear()
        self._given = self._taken = 0
        self.sender.forget()
        super().drop()

    def _pack(self) -> None:
        if self._instrument.tick_us != self._tick_us:
            self._tick_us = self._instrument.tick_us
            self.sender.set_tick(self._tick_us)
        outgoing = self._instrument.next_events(_RAW_EVENTS_A_TIME)
        if outgoing is None:
            self._frames += self.sender.epoch(self._instrument.own_us, self._instrument.counters.dropped_for_room)
            return
        own = copy_events(outgoing.events)
        self._epoch_us = outgoing.epoch_us
        epoch = np.uint64(outgoing.epoch_us % (1 << 64))
        own["t"] -= epoch
        self._frames += self.sender.pack(own, self._instrument.counters.dropped_for_room)
        own["t"] = own["t"] // np.uint64(self._tick_us) * np.uint64(self._tick_us) + epoch
        self._outgoing = Outgoing(outgoing.message, own, outgoing.edges, outgoing.epoch_us, outgoing.dropped)


class RawEdges(FrameSource):
    """Edges on the external input, a frame each.

    They begin between two groups of events frames: the clock and epoch frames of both come from one sender, and have to
    leave in the order in which it made them.
    """

    def __init__(self, instrument: Instrument, deliveries: Deliveries, events: RawEvents, identifier: int) -> None:
        super().__init__(instrument, deliveries)
        self._events = events
        self._identifier = identifier
        self._frames: deque[tuple[Frame, Edges]] = deque()
        self._load = Load.nothing()

    def next_frame(self, now_ns: int) -> Frame | None:
        """See `FrameSource.next_frame`."""
        if self._outgoing is None:
            self._outgoing = None if self._events.halfway else self._instrument.next_edges()
            if self._outgoing is None:
                return None
            self._pack(self._outgoing)
        if not self._frames:
            return None
        frame, edges = self._frames.popleft()
        self._load = Load(empty_events(), edges, self._outgoing.epoch_us)
        return frame

    @property
    def load(self) -> Load:
        """See `FrameSource.load`."""
        return Load.nothing() if self._outgoing is None else self._load

    def _pack(self, outgoing: Outgoing) -> None:
        own = outgoing.edges.copy()
        own["t"] -= np.uint64(outgoing.epoch_us % (1 << 64))
        for at, data in enumerate(pack_marks(own)):
            before = self._events.sender.time_frames(int(own["t"][at]))
            self._frames += [(packed.frame, empty_edges()) for packed in before]
            self._frames.append((Frame(self._identifier, data), outgoing.edges[at : at + 1]))

    def left(self) -> Outgoing | None:
        """See `FrameSource.left`."""
        return None if self._frames else self._finished()

    def drop(self) -> None:
        """See `FrameSource.drop`."""
        self._frames.clear()
        self._events.sender.forget()
        super().drop()


class IsoTpMail(FrameSource):
    """Messages by ISO-TP, and telecommands the same way back; `with_all` when events and edges go this way too."""

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
        """See `FrameSource.next_frame`."""
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
        """See `FrameSource.left`."""
        return None if self._sender.busy else self._finished()

    def drop(self) -> None:
        """See `FrameSource.drop`."""
        self._sender.abort()
        super().drop()

    def reader(self) -> Callable[[Frame], list[Received]]:
        """See `FrameSource.reader`."""
        peer = replace(self._settings, send=self._settings.receive, receive=self._settings.send)
        receiver, unwrapper = IsoTpReceiver(peer), Profile("ccsds").unwrapper()
        return lambda frame: unwrapper.push(receiver.push(frame, 0) or b"")

    def hear(self, frame: Frame, now_ns: int) -> Frame | None:
        """See `FrameSource.hear`."""
        if not self._settings.is_ours(frame):
            return None
        if frame.data and frame.data[0] >> 4 == 3:
            self._flow_control(frame, now_ns)
            return None
        packet = self._receiver.push(frame, now_ns)
        if packet is not None:
            _obey(self._instrument, self._commands, packet)
        return self._receiver.reply

    def _flow_control(self, frame: Frame, now_ns: int) -> None:
        try:
            self._sender.flow_control(frame, now_ns)
        except IsoTpFailure:
            self.faults["messages refused by the peer"] += 1
            self.drop()


class CfpMail(FrameSource):
    """Messages in CSP packets, cut up by CFP 2, and telecommands the same way back."""

    label = "CFP"

    def __init__(self, instrument: Instrument, deliveries: Deliveries, parameters: CanLink) -> None:
        super().__init__(instrument, deliveries)
        self._address, self._peer = parameters.csp_address, parameters.csp_peer
        self._profile = Profile("csp", Addresses(csp_node=parameters.csp_address, csp_peer=parameters.csp_peer))
        self._commands = self._profile.command_unwrapper()
        self._receiver = CfpReceiver(parameters.csp_address)
        self._frames: deque[Frame] = deque()
        self._packets = 0
        self.faults = self._receiver.faults

    def next_frame(self, now_ns: int) -> Frame | None:
        """See `FrameSource.next_frame`."""
        if self._outgoing is None:
            self._outgoing = self._instrument.next_message()
            if self._outgoing is None:
                return None
            packet = self._profile.wrap(self._outgoing.message)
            self._frames += cfp_frames(packet, self._address, self._packets)
            self._packets += 1
        return self._frames.popleft() if self._frames else None

    def left(self) -> Outgoing | None:
        """See `FrameSource.left`."""
        return None if self._frames else self._finished()

    def drop(self) -> None:
        """See `FrameSource.drop`."""
        self._frames.clear()
        super().drop()

    def reader(self) -> Callable[[Frame], list[Received]]:
        """See `FrameSource.reader`."""
        addresses = Addresses(csp_node=self._address, csp_peer=self._peer)
        receiver, unwrapper = CfpReceiver(self._peer), Profile("csp", addresses).unwrapper()
        return lambda frame: unwrapper.push(receiver.push(frame, 0) or b"")

    def hear(self, frame: Frame, now_ns: int) -> Frame | None:
        """See `FrameSource.hear`."""
        packet = self._receiver.push(frame, now_ns)
        if packet is not None:
            _obey(self._instrument, self._commands, packet)
        return None


def sources(instrument: Instrument, deliveries: Deliveries, parameters: CanLink) -> list[FrameSource]:
    """Return what a link sends, the more urgent first."""
    if parameters.carriage == "cfp":
        return [CfpMail(instrument, deliveries, parameters)]
    if parameters.carriage == "isotp":
        return [IsoTpMail(instrument, deliveries, parameters.isotp, with_all=True)]
    events = RawEvents(instrument, deliveries, RawSender(parameters.raw(instrument.tick_us)))
    return [
        RawEdges(instrument, deliveries, events, parameters.identifiers.edges),
        IsoTpMail(instrument, deliveries, parameters.isotp, with_all=False),
        events,
    ]


def _obey(instrument: Instrument, commands: CommandUnwrapper, packet: bytes) -> None:
    for received in commands.push(packet):
        instrument.command(received)
