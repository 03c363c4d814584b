"""Answers of an instrument: verification of telecommands as in PUS service 1, and housekeeping reports.

Answers wait for the line in a bounded queue of messages; the oldest are dropped first.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from firmware_protocol.device.fates import Fates
from firmware_protocol.instrument.queue import OwnTime, Selection
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.housekeeping import EdgeCounts, EventCounts, Housekeeping, LinkCounts, Mode, TimeStatus
from firmware_protocol.packets.profile import ReceivedCommand
from firmware_protocol.packets.pus import Acknowledge
from firmware_protocol.packets.telecommands import Failure, Stage, Verification

_MOST_ANSWERS = 256
_MOST_HZ = 0xFFFF_FFFF


class Answers:
    """Queue of answers; if requests arrive faster than the line sends answers, the oldest answers are dropped.

    Attributes
    ----------
    taken, refused, missing
        Numbers of telecommands so far.
    """

    def __init__(self, time: OwnTime) -> None:
        self._time = time
        self._waiting: deque[Message] = deque(maxlen=_MOST_ANSWERS)
        self.taken = self.refused = self.missing = 0

    def put(self, kind: MessageKind, payload: bytes) -> None:
        """Queue an answer, dated with the camera's time now."""
        self._waiting.append(Message(kind, payload, self._time.own_us))

    def accept(self, received: ReceivedCommand) -> None:
        """Report that a telecommand is accepted."""
        self._verify(received, Stage.ACCEPTANCE, Acknowledge.ACCEPTANCE)

    def complete(self, received: ReceivedCommand) -> None:
        """Report that a telecommand is executed."""
        self.taken += 1
        self._verify(received, Stage.COMPLETION, Acknowledge.COMPLETION)

    def refuse(self, received: ReceivedCommand, stage: Stage, failure: Failure | None) -> None:
        """Report that a telecommand has failed at a stage."""
        self.refused += 1
        self.put(MessageKind.VERIFICATION, Verification(stage, received.request, failure).encode())

    def take(self) -> Message | None:
        """Return the oldest answer; None if none waits."""
        return self._waiting.popleft() if self._waiting else None

    def clear(self) -> None:
        """Drop all answers."""
        self._waiting.clear()

    def _verify(self, received: ReceivedCommand, stage: Stage, wanted: Acknowledge) -> None:
        if received.acknowledge & wanted:
            self.put(MessageKind.VERIFICATION, Verification(stage, received.request).encode())


@dataclass(frozen=True)
class State:
    """State of an instrument for housekeeping; `now_us` is stream time, `own_us` the camera's."""

    now_us: int
    own_us: int
    streaming: bool
    time_status: TimeStatus
    tick_us: int
    rate_limit: int
    selection: Selection
    temperature_c: float
    counters: Fates
    link: LinkCounts


class Reporter:
    """Source of housekeeping reports, one every `period_us` of stream time; with 0 only on request."""

    def __init__(self, period_us: int) -> None:
        self._period_us = period_us
        self._next_us = 0
        self._last_us = self._offered = self._sent = 0

    def due(self, now_us: int) -> bool:
        """Return true if the next report is due."""
        return self._period_us > 0 and now_us >= self._next_us

    def report(self, state: State) -> Housekeeping:
        """Return the report; rates are since the last one."""
        c, selection = state.counters, state.selection
        seconds = (state.now_us - self._last_us) * 1e-6
        offered_hz, sent_hz = (
            min(_MOST_HZ, round(count / seconds)) if seconds > 0 else 0
            for count in (c.offered - self._offered, c.delivered - self._sent)
        )
        self._last_us, self._offered, self._sent = state.now_us, c.offered, c.delivered
        if self._period_us:
            self._next_us = (state.now_us // self._period_us + 1) * self._period_us
        return Housekeeping(
            t_us=state.own_us,
            region=(selection.x, selection.y, selection.width, selection.height),
            mode=Mode.STREAMING if state.streaming else Mode.STOPPED,
            time_status=state.time_status,
            offered_hz=offered_hz,
            sent_hz=sent_hz,
            temperature_centi_c=round(100 * state.temperature_c),
            tick_us=state.tick_us,
            rate_limit_hz=state.rate_limit,
            events=_events(c),
            edges=EdgeCounts(c.edges.offered, c.edges.delivered, c.edges.ignored, c.edges.dropped_for_room),
            link=state.link,
        )


def _events(c: Fates) -> EventCounts:
    return EventCounts(
        offered=c.offered,
        sent=c.delivered,
        waiting=c.queued,
        not_running=c.not_running,
        not_selected=c.not_selected,
        over_rate=c.dropped_rate,
        too_late=c.dropped_late,
        buffer_full=c.dropped_fifo,
        flushed=c.flushed,
        lost_on_link=c.lost_on_link,
    )
