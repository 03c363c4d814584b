"""The computer's side of a serial line, or of a DAVIS346 on USB: bytes in, events, edges and reports out.

    receiver = SerialReceiver("ccsds-cobs")
    receiver.push(port.read())
    events = receiver.take_events()

    receiver = DavisReceiver()
    receiver.push(bulk_in(0x82))
    events = receiver.take_events()

No I/O and no clock.

`Inbox` stores received events, edges and reports, bounded, until the caller takes them. `MessageReader` reads an
instrument's messages: events and edges go to the inbox, answers become reports.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from firmware_protocol.davis346.decoder import Decoder
from firmware_protocol.events import Edges, Events, empty_edges, empty_events, join_events
from firmware_protocol.packets.addresses import Message, MessageKind, PacketError
from firmware_protocol.packets.housekeeping import Housekeeping
from firmware_protocol.packets.profile import Profile
from firmware_protocol.packets.telecommands import RequestId, Telecommand, Verification
from firmware_protocol.telemetry.layout import BlockError
from firmware_protocol.telemetry.reading import decode_block
from firmware_protocol.telemetry.writing import BlockEncoder, BlockSettings

_MOST_EVENTS = 1 << 22
_MOST_EDGES = 1 << 16
_MOST_REPORTS = 1024


class _Waiting:
    """Records that wait to be taken; beyond a limit the oldest are dropped, and counted in `not_taken`."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._parts: deque[Events] = deque()
        self._records = 0
        self.not_taken = 0

    def put(self, records: Events) -> None:
        """Store records, without a copy."""
        if not len(records):
            return
        self._parts.append(records)
        self._records += len(records)
        while (excess := self._records - self._limit) > 0:
            oldest = self._parts.popleft()
            if len(oldest) > excess:
                self._parts.appendleft(oldest[excess:])
            gone = min(excess, len(oldest))
            self._records -= gone
            self.not_taken += gone

    def take(self) -> list[Events]:
        """Return the parts that wait."""
        taken = list(self._parts)
        self._parts.clear()
        self._records = 0
        return taken


class Inbox:
    """Stores received data, and drops the oldest of each kind beyond a limit.

    Parameters
    ----------
    most_events, most_edges : most events and edges that wait to be taken.
    """

    def __init__(self, most_events: int = _MOST_EVENTS, most_edges: int = _MOST_EDGES) -> None:
        self._events = _Waiting(most_events)
        self._edges = _Waiting(most_edges)
        self._reports: deque[str] = deque()
        self._reports_not_taken = 0

    def put_events(self, events: Events) -> None:
        """Store events (n,), without a copy."""
        self._events.put(events)

    def put_edges(self, edges: Edges) -> None:
        """Store edges (n,), without a copy."""
        self._edges.put(edges)

    def put_report(self, report: str) -> None:
        """Store a line of text for people."""
        if len(self._reports) == _MOST_REPORTS:
            self._reports.popleft()
            self._reports_not_taken += 1
        self._reports.append(report)

    def take_events(self) -> Events:
        """Return the events received since the last call, (n,) EVENT in the camera's time, in the order of arrival."""
        return join_events(self._events.take())

    def take_edges(self) -> Edges:
        """Return the edges received since the last call, (n,) EDGE in the camera's time, in the order of arrival."""
        return np.concatenate([empty_edges(), *self._edges.take()])

    def take_reports(self) -> tuple[str, ...]:
        """Return the reports received since the last call."""
        taken = tuple(self._reports)
        self._reports.clear()
        return taken

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of items not taken in time, by name; only those that are not zero."""
        counts = {
            "events not taken": self._events.not_taken,
            "edges not taken": self._edges.not_taken,
            "reports not taken": self._reports_not_taken,
        }
        return {name: count for name, count in counts.items() if count}


class Receiver:
    """Common part of all receivers: the data that they have decoded wait in an inbox."""

    def __init__(self) -> None:
        self._inbox = Inbox()

    def take_events(self) -> Events:
        """Return the events since the last call, (n,) EVENT in the camera's time."""
        return self._inbox.take_events()

    def take_edges(self) -> Edges:
        """Return the edges since the last call, (n,) EDGE in the camera's time; a camera's own marks are among them."""
        return self._inbox.take_edges()

    def take_reports(self) -> tuple[str, ...]:
        """Return the camera's answers since the last call, in words for people; a DAVIS346 sends none."""
        return self._inbox.take_reports()


_MOST_REQUESTS = 1024


class MessageReader:
    """Reads messages, from packets of any standard.

    Attributes
    ----------
    counts : messages by kind, `events_dropped` and `edges_dropped` from the blocks, `bad_blocks`, `bad_answers`.
    housekeeping : the newest report; None before the first.
    """

    def __init__(self, inbox: Inbox) -> None:
        self._inbox = inbox
        self._requests: dict[RequestId, str] = {}
        self.counts: Counter[str] = Counter()
        self.housekeeping: Housekeeping | None = None
        # Load the decoder's compiled code before data arrive: it takes a good part of a second.
        for mode in ("rows", "bitmap", "flat"):
            block, _ = BlockEncoder((2, 2), BlockSettings(mode=mode)).encode(empty_events(2))
            decode_block(block)

    def expect(self, request: RequestId, name: str) -> None:
        """Store the name of a telecommand for the verifications of `request`; the last 1024 are stored."""
        if len(self._requests) == _MOST_REQUESTS:
            del self._requests[next(iter(self._requests))]
        self._requests[request] = name

    def read(self, message: Message) -> None:
        """Process a message; one with a bad payload is counted."""
        self.counts[message.kind.value] += 1
        if message.kind in (MessageKind.EVENTS, MessageKind.EDGES):
            self._block(message)
        else:
            self._answer(message)

    @property
    def bad(self) -> int:
        """Number of messages in valid packets whose payload was wrong."""
        return self.counts["bad_blocks"] + self.counts["bad_answers"]

    def _block(self, message: Message) -> None:
        try:
            block = decode_block(message.payload, message.t_us)
        except BlockError:
            self.counts["bad_blocks"] += 1
            return
        self.counts["events_dropped" if message.kind is MessageKind.EVENTS else "edges_dropped"] += block.header.dropped
        self._inbox.put_events(block.events)
        self._inbox.put_edges(block.edges)

    def _answer(self, message: Message) -> None:
        try:
            if message.kind is MessageKind.HOUSEKEEPING:
                self.housekeeping = Housekeeping.parse(message.payload)
            elif message.kind is MessageKind.VERIFICATION:
                self._inbox.put_report(self._verified(Verification.parse(message.payload)))
            else:
                self._inbox.put_report(message.kind.value)
        except PacketError:
            self.counts["bad_answers"] += 1

    def _verified(self, verification: Verification) -> str:
        command = self._requests.get(verification.request, "a telecommand of another sender")
        stage = verification.stage.name.lower()
        if verification.failure is None:
            return f"{command}: {stage} good"
        return f"{command}: {stage} failed: {verification.failure.text} (code {verification.failure.code.value})"


class SerialReceiver(Receiver):
    """Decodes an instrument's bytes; wraps telecommands and follows their answers.

    `profile`: the name of one of `PROFILES`, or a profile with other addresses. Raises ValueError for an unknown name.
    """

    def __init__(self, profile: Profile | str = "ccsds-cobs") -> None:
        super().__init__()
        self._profile = Profile(profile) if isinstance(profile, str) else profile
        self._unwrapper = self._profile.unwrapper()
        self._messages = MessageReader(self._inbox)
        self._telecommands = self._resynchronised = 0
        self._began = self._lost = False
        self._damaged_at_start = 0
        self._damaged = 0

    def wrap(self, command: Telecommand) -> bytes:
        """Return the bytes of a telecommand; its answers arrive as reports."""
        octets = self._profile.wrap_command(command)
        if self._profile.last_request is not None:
            self._messages.expect(self._profile.last_request, type(command).__name__)
        self._telecommands += 1
        return octets

    def push(self, data: bytes) -> None:
        """Process the next bytes, any number of them; never raises."""
        messages = self._unwrapper.push(data)
        self._follow(bool(messages))
        for received in messages:
            self._messages.read(received.message)

    @property
    def housekeeping(self) -> Housekeeping | None:
        """The newest report; None before the first."""
        return self._messages.housekeeping

    @property
    def faults(self) -> int:
        """Number of faults that never occur on a correct line: damage after the first good frame, gaps, bad blocks."""
        seen = self._unwrapper.counters
        return self._damaged - self._damaged_at_start + seen.missing + seen.disordered + self._messages.bad

    @property
    def counts(self) -> Mapping[str, int]:
        """All counts by name."""
        seen = self._unwrapper.counters
        reasons = seen.frames.refused + seen.refused
        counts = {
            "bytes": seen.frames.bytes_received,
            "bytes_skipped": seen.frames.bytes_skipped,
            "frames": seen.frames.frames,
            "messages_missing": seen.missing,
            "messages_disordered": seen.disordered,
            **{f"damaged: {reason}": count for reason, count in reasons.items()},
            **self._messages.counts,
            **self._inbox.counts,
        }
        occasional = {"telecommands": self._telecommands, "resynchronised": self._resynchronised}
        return counts | {name: count for name, count in occasional.items() if count}

    def _follow(self, good: bool) -> None:
        """Count losses and recoveries of the stream; damage before the first frame is no fault."""
        seen = self._unwrapper.counters
        damaged = sum(seen.frames.refused.values()) + sum(seen.refused.values())
        self._lost |= self._began and damaged > self._damaged
        self._damaged = damaged
        if good and not self._began:
            self._began, self._damaged_at_start = True, damaged
        elif good and self._lost:
            self._lost = False
            self._resynchronised += 1


class DavisReceiver(Receiver):
    """Decodes the word stream of endpoint 0x82; times are device time, which a timestamp reset sets to zero.

    Parameters
    ----------
    size : (width, height) in user coordinates.
    turned : True if the invert bit of the orientation register is set.
    """

    def __init__(self, size: tuple[int, int] = (346, 260), turned: bool = False) -> None:
        super().__init__()
        self._decoder = Decoder(size, turned)
        self._bytes = self._events = self._edges = self._resets = 0

    def push(self, data: bytes) -> None:
        """Process the next bytes of the stream, any number of them; never raises."""
        decoded = self._decoder.feed(data)
        self._bytes += len(data)
        self._events += len(decoded.events)
        self._edges += len(decoded.edges)
        self._resets += len(decoded.resets)
        self._inbox.put_events(decoded.events)
        self._inbox.put_edges(decoded.edges)

    @property
    def counts(self) -> Mapping[str, int]:
        """All counts by name; only those that are not zero."""
        counts = {"bytes": self._bytes, "events": self._events, "edges": self._edges, "resets": self._resets}
        counts |= asdict(self._decoder.faults) | self._inbox.counts
        return {name: count for name, count in counts.items() if count}

    @property
    def faults(self) -> int:
        """Number of words that never occur in a correct stream."""
        return self._decoder.faults.total
