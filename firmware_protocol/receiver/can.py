"""The computer's side of a CAN link: frames in, events, edges and reports out. No I/O: the caller pushes frames.

receiver = CanReceiver(CanReceiverSettings(Identifiers.of_node(0x22)))
receiver.push(frame, now_ns)
for reply in receiver.take_replies():
    bus.send(reply)
events = receiver.take_events()
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from firmware_protocol.can_frames.canopen import ObjectError
from firmware_protocol.can_frames.dbc import Identifiers
from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.raw_events import unpack_mark
from firmware_protocol.can_frames.raw_stream import RawReceiver
from firmware_protocol.can_frames.transport import CfpReceiver, IsoTpReceiver, IsoTpSettings
from firmware_protocol.packets.addresses import Addresses
from firmware_protocol.packets.housekeeping import Housekeeping
from firmware_protocol.packets.profile import Profile, Unwrapper
from firmware_protocol.receiver.instrument import MessageReader, Receiver

_MOST_REPLIES = 64


@dataclass(frozen=True)
class CanReceiverSettings:
    """Settings that a computer needs to decode a camera on a CAN bus.

    Attributes
    ----------
    identifiers : identifiers of all frames.
    fd : ISO-TP flow control goes in CAN FD frames.
    flow_control : answer ISO-TP messages with flow control.
    answer_ms : longest pause inside an ISO-TP message.
    csp_address, csp_peer : CSP addresses of camera and computer.
    """

    identifiers: Identifiers = field(default_factory=Identifiers)
    fd: bool = False
    flow_control: bool = True
    answer_ms: int = 1000
    csp_address: int = 10
    csp_peer: int = 1

    @property
    def isotp(self) -> IsoTpSettings:
        """The computer's end of the ISO-TP channel."""
        ids, timeout_ns = self.identifiers, self.answer_ms * 1_000_000
        return IsoTpSettings(
            ids.telecommand, ids.telemetry, fd=self.fd, flow_control=self.flow_control, timeout_ns=timeout_ns
        )

    @property
    def addresses(self) -> Addresses:
        """Addresses of both sides in CSP packets."""
        return Addresses(csp_node=self.csp_address, csp_peer=self.csp_peer)


class CanReceiver(Receiver):
    """Decodes the frames of a camera: raw frames, ISO-TP and CFP, also mixed."""

    def __init__(self, settings: CanReceiverSettings | None = None) -> None:
        super().__init__()
        settings = settings or CanReceiverSettings()
        ids = settings.identifiers
        self._names = {value: name for name, value in ids.by_name.items()}
        self._edge_ids = (ids.edges, ids.marks)
        self._raw = RawReceiver(ids.events, ids.epoch, ids.clock)
        self._isotp = IsoTpReceiver(settings.isotp)
        self._cfp = CfpReceiver(settings.csp_peer)
        self._from_isotp = Profile("ccsds").unwrapper()
        self._from_cfp = Profile("csp", settings.addresses).unwrapper()
        self._messages = MessageReader(self._inbox)
        self._replies: deque[Frame] = deque(maxlen=_MOST_REPLIES)
        self._frames: Counter[str] = Counter()
        self._missing = self._message_us = 0

    def push(self, frame: Frame, now_ns: int = 0) -> None:
        """Process a frame received at `now_ns`, which bounds pauses inside a message; never raises."""
        name = "CFP" if frame.extended else self._names.get(frame.identifier, f"{frame.identifier:03X}")
        self._frames["error frame" if frame.error else name] += 1
        self._inbox.put_events(self._raw.push(frame))
        if frame.identifier in self._edge_ids and not frame.extended:
            try:
                # The camera's newest time: of raw frames, or if there are none of messages.
                near_us = self._message_us if self._raw.now_us is None else self._raw.now_us
                self._inbox.put_edges(unpack_mark(frame.data, near_us))
            except ObjectError:
                self._frames["edge frames malformed"] += 1
        self._open(self._from_isotp, self._isotp.push(frame, now_ns))
        if self._isotp.reply is not None:
            self._replies.append(self._isotp.reply)
        self._open(self._from_cfp, self._cfp.push(frame, now_ns))

    def take_replies(self) -> list[Frame]:
        """Return the frames to send at once, in order: flow control."""
        replies = list(self._replies)
        self._replies.clear()
        return replies

    @property
    def housekeeping(self) -> Housekeeping | None:
        """The newest report; None before the first."""
        return self._messages.housekeeping

    @property
    def counts(self) -> Mapping[str, int]:
        """Received, missing and faulty items by name; only those that are not zero."""
        raw, messages = self._raw.counters, self._messages.counts
        kinds = {f"frames: {name}": n for name, n in self._frames.items()}
        counts = {
            **kinds,
            **{f"messages: {name}": n for name, n in messages.items() if name not in _COUNTED_APART},
            "events lost": raw.lost,
            "events dropped by the camera": raw.dropped + messages["events_dropped"],
            "edges dropped by the camera": messages["edges_dropped"],
            "gaps in raw frames": raw.gaps,
            "raw frames repeated": raw.repeated,
            "raw frames before an epoch": raw.before_epoch,
            "raw frames before a clock frame": raw.before_clock,
            "raw frames malformed": raw.malformed,
            "packets missing": self._missing,
            "packets refused": sum(
                sum(u.counters.refused.values()) + sum(u.counters.frames.refused.values())
                for u in (self._from_isotp, self._from_cfp)
            ),
            "blocks refused": messages["bad_blocks"],
            "answers refused": messages["bad_answers"],
            **{f"ISO-TP {name}": n for name, n in self._isotp.faults.items()},
            **{f"CFP {name}": n for name, n in self._cfp.faults.items()},
            **self._inbox.counts,
        }
        return {name: n for name, n in counts.items() if n}

    @property
    def faults(self) -> int:
        """Number of faults that never occur on a correct link; a late start of the receiver is no fault."""
        raw = self._raw.counters
        cut = sum(n for name, n in self._isotp.faults.items() if name != "without a beginning")
        cut += sum(n for name, n in self._cfp.faults.items() if name != "without a beginning")
        return raw.lost + raw.gaps + raw.repeated + raw.malformed + self._missing + self._messages.bad + cut

    def _open(self, unwrapper: Unwrapper, packet: bytes | None) -> None:
        if packet is None:
            return
        for received in unwrapper.push(packet):
            self._missing += received.missing
            self._messages.read(received.message)
            self._message_us = received.message.t_us


_COUNTED_APART = frozenset({"events_dropped", "edges_dropped", "bad_blocks", "bad_answers"})
