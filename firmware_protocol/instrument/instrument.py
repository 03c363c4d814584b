"""An event camera on a narrow link: events and edges in, messages out, telecommands in. Sans-I/O.

    offer -------> selection -> queue --+
    offer_edges -> edges ---------------+--> next_message --> Outgoing -+-> sent
    advance -----> housekeeping due ----+         ^                     +-> lost
    command -----> execute; verification, pong, time report

A message is formed when the link requests it, as late as possible: a link with spare capacity takes small recent
blocks, a busy one takes full blocks. Answers are sent first, then edges, housekeeping, events.

The camera's own time is stream time plus an offset that SetTime changes; all outgoing times are own times.

Answers, the verification of telecommands as in PUS service 1 and what they request, wait for the line in a bounded
queue of messages; the oldest are dropped first.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from firmware_protocol.device.event_device import EventDevice, HasClockInput, HostAdjusted
from firmware_protocol.device.fates import Fates
from firmware_protocol.device.items import Numbers
from firmware_protocol.events import Edges, Events
from firmware_protocol.instrument.event_path import EdgePath, EventPath, Outgoing, block_settings
from firmware_protocol.instrument.queue import OwnTime, Selection
from firmware_protocol.instrument.settings import DavisBiases, InstrumentSettings, SensorBiases
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.ccsds import Acknowledge
from firmware_protocol.packets.housekeeping import EdgeCounts, EventCounts, Housekeeping, LinkCounts, Mode, TimeReport
from firmware_protocol.packets.profile import ReceivedCommand
from firmware_protocol.packets.telecommands import (
    CommandRefused,
    Failure,
    FailureCode,
    Ping,
    RequestHousekeeping,
    SetBias,
    SetRateLimit,
    SetRegion,
    SetTick,
    SetTime,
    Stage,
    Start,
    Stop,
    Telecommand,
    Verification,
)
from firmware_protocol.telemetry.writing import BlockEncoder

_MOST_ANSWERS = 256
_MOST_HZ = 0xFFFF_FFFF


class Answers:
    """Queue of answers; if requests arrive faster than the line sends answers, the oldest answers are dropped.

    `taken`, `refused`, `missing`: numbers of telecommands so far.
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

    def _verify(self, received: ReceivedCommand, stage: Stage, success: Acknowledge) -> None:
        if received.acknowledge & success:
            self.put(MessageKind.VERIFICATION, Verification(stage, received.request).encode())


class Reporter:
    """Times of housekeeping reports, one every `period_us` of stream time (0: only on request), and rates in them."""

    def __init__(self, period_us: int) -> None:
        self._period_us = period_us
        self._next_us = 0
        self._last_us = self._offered = self._sent = 0

    def due(self, now_us: int) -> bool:
        """Return true if the next report is due."""
        return self._period_us > 0 and now_us >= self._next_us

    def rates_hz(self, now_us: int, fates: Fates) -> tuple[int, int]:
        """Return the events offered and sent a second since the last report; the report is made now."""
        seconds = (now_us - self._last_us) * 1e-6
        offered_hz, sent_hz = (
            min(_MOST_HZ, round(count / seconds)) if seconds > 0 else 0
            for count in (fates.offered - self._offered, fates.delivered - self._sent)
        )
        self._last_us = now_us
        self._offered, self._sent = fates.offered, fates.delivered
        if self._period_us:
            self._next_us = (now_us // self._period_us + 1) * self._period_us
        return offered_hz, sent_hz


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


__all__ = ["Instrument", "Outgoing"]


_MOST_EXECUTED = 256  # between two calls of take_commands, a millisecond apart at most
_NO_LIMIT = 1 << 30
_NO_MESSAGE = Message(MessageKind.EVENTS, b"", 0)


class Instrument(EventDevice, HostAdjusted, HasClockInput):
    """The camera; raises ValueError for settings that do not fit the array.

    Parameters
    ----------
    size : (width, height) of the array.
    biases : biases of its sensor; by default those of a DAVIS346.

    Attributes
    ----------
    frames_refused : damaged frames that the link received; the link sets it, housekeeping reports it.
    takes_edges : True if its link carries edges; if not, they are ignored.
    """

    set_by = "telecommand"

    def __init__(
        self, size: tuple[int, int], settings: InstrumentSettings | None = None, biases: SensorBiases | None = None
    ) -> None:
        self.settings = settings = settings or InstrumentSettings()
        self._fates = Fates()
        self._time = OwnTime()
        self._path = EventPath(size, settings, self._fates, self._time)
        self._edges = EdgePath(BlockEncoder(size, block_settings(settings)), self._fates, self._time)
        self._answers = Answers(self._time)
        self._executed: deque[str] = deque(maxlen=_MOST_EXECUTED)
        self._reporter = Reporter(round(settings.housekeeping_s * 1e6))
        self._started, self._connected = settings.autostart, True
        self._biases: SensorBiases = biases or DavisBiases()
        self.frames_refused = 0
        self.takes_edges = True

    @property
    def now_us(self) -> int:
        """Stream time that the camera has reached."""
        return self._time.now_us

    @property
    def own_us(self) -> int:
        """The camera's own time; never negative."""
        return self._time.own_us

    @property
    def tick_us(self) -> int:
        """Unit of event times."""
        return self._path.tick_us

    @property
    def streaming(self) -> bool:
        """True while events offered now would be sent."""
        return self._started and self._connected

    @property
    def at_rest(self) -> bool:
        """True while no receiver is present."""
        return not self._connected

    @property
    def room_events(self) -> int:
        """Events that certainly fit the queue now."""
        return self._path.queue.room

    @property
    def horizon_us(self) -> int:
        """Stream time to which the camera can advance now before a waiting event reaches its age limit."""
        patience_us = self._path.patience_us if self.streaming else None
        if patience_us is None:
            return super().horizon_us
        oldest_us = self._path.queue.oldest_us
        return patience_us + (self._time.now_us if oldest_us is None else oldest_us)

    @property
    def _waiting(self) -> Numbers:
        return self._path.waiting.plus(self._edges.waiting)

    def offer(self, events: Events) -> None:
        """Take events of the array, sorted; raises ValueError for others."""
        if not len(events):
            return
        if int(events["t"][0]) < self._time.now_us:
            raise ValueError(
                f"event at {events['t'][0]} us offered after the camera's clock reached {self._time.now_us} us"
            )
        self._path.check(events)
        self._time.reach(int(events["t"][-1]))
        self._fates.offered += len(events)
        if self.streaming:
            self._path.put(events)
        else:
            self._fates.not_running += len(events)

    def offer_edges(self, edges: Edges) -> None:
        """Apply edges to the external input, while the camera runs."""
        seen = (
            self.streaming and self.takes_edges and not (edges["t"].astype(np.int64) + self._time.offset_us < 0).any()
        )
        (self._edges.put if seen else self._edges.ignore)(edges)

    def advance(self, now_us: int) -> None:
        """Set stream time, and drop the events that have waited too long."""
        self._time.reach(now_us)
        self._path.advance()

    @property
    def sensor_factors(self) -> Mapping[str, float]:
        """Effect of the commanded biases on the pixels; empty before the first."""
        return self._biases.factors

    @property
    def without_effect(self) -> Mapping[str, str]:
        """Commanded biases without an effect on the sensor, each with the reason."""
        return self._biases.without_effect

    @property
    def biases(self) -> Mapping[int, int]:
        """Biases by number, as commanded; see `settings`."""
        return self._biases.values

    def connected(self) -> None:
        """Note that a receiver is present; so it is from the start, until `disconnected`."""
        self._connected = True

    def disconnected(self) -> None:
        """Note that no receiver is present: drop what waits, and count new events as not running."""
        self._connected = False
        self._answers.clear()
        self._clear()

    def start(self) -> None:
        """Start the flow of events."""
        self._started = True

    def stop(self) -> None:
        """Stop the flow of events, and drop those that wait."""
        self._started = False
        self._clear()

    def set_time(self, t_us: int) -> None:
        """Set the camera's own time to `t_us`; raises ValueError if that is too far in the future."""
        self._time.set(t_us)
        self._drop_before_zero()

    @property
    def epoch_us(self) -> int:
        """Stream time at which the camera's own time is zero; negative if it was set ahead."""
        return self._time.epoch_us

    def restart_clock(self) -> bool:
        """Set the camera's own time to zero without a command; drop what waits, for its times would be negative."""
        self._time.restart()
        self._drop_before_zero()
        return True

    def next_message(self, *, events: bool = True, edges: bool = True) -> Outgoing | None:
        """Return the next message to send, None if there is none; without content that the link packs itself.

        `sent` or `lost` must follow for each, in the order of the calls.
        """
        if (answer := self._answers.take()) is not None:
            return Outgoing(message=answer)
        if edges and (outgoing := self.next_edges()):
            return outgoing
        if self._reporter.due(self._time.now_us):
            return Outgoing(message=Message(MessageKind.HOUSEKEEPING, self.report().encode(), self.own_us))
        return self._taken(self._path.take(self._time.now_us, _NO_LIMIT)) if events else None

    def next_edges(self) -> Outgoing | None:
        """Hand out the waiting edges; otherwise as `next_message`."""
        return self._taken(self._edges.take(self._time.now_us, _NO_LIMIT))

    def next_events(self, limit: int) -> Outgoing | None:
        """Hand out up to `limit` events for a link that packs them itself; otherwise as `next_message`."""
        return self._taken(self._path.take_unpacked(limit))

    def next_items(self, limit: int) -> Outgoing:
        """Hand out up to `limit` events and the edges before the next one, perhaps none, for a link that packs both."""
        taken = self._path.take_unpacked(limit) or Outgoing(epoch_us=self.epoch_us, message=_NO_MESSAGE)
        next_us = self._path.queue.oldest_us
        edges = self._edges.take_until(self._time.now_us if next_us is None else next_us)
        outgoing = replace(taken, edges=edges)
        self._fates.take(outgoing)
        return outgoing

    def command(self, received: ReceivedCommand) -> None:
        """Execute a telecommand, and answer as PUS service 1 does."""
        self._answers.missing += received.missing
        if received.command is None:
            self._answers.refuse(received, Stage.ACCEPTANCE, received.failure)
            return
        self._answers.accept(received)
        try:
            self.execute(received.command)
        except ValueError as error:
            failure = CommandRefused(FailureCode.ILLEGAL_DATA, str(error)).failure
            self._answers.refuse(received, Stage.COMPLETION, failure)
        else:
            self._answers.complete(received)

    def execute(self, command: Telecommand) -> None:
        """Execute a telecommand; raises ValueError if its values do not fit the camera."""
        match command:
            case Start():
                self.start()
            case Stop():
                self.stop()
            case SetTick(tick_us):
                self._path.set_tick(tick_us)
            case SetRegion(x, y, width, height):
                self._path.select(Selection(x, y, width, height, self._path.selection.keep_every))
            case SetRateLimit(events_per_s):
                self._path.limit(events_per_s)
            case SetTime(t_us):
                self.set_time(t_us)
                self._answers.put(MessageKind.TIME, TimeReport(t_us, self._time.status).encode())
            case SetBias(bias, value):
                self._biases.set(bias, value)
            case _:
                self._answer(command)
                return
        self.settings_version += 1
        self._executed.append(repr(command))

    def _answer(self, request: Telecommand) -> None:
        """Answer a request that changes nothing."""
        match request:
            case Ping():
                self._answers.put(MessageKind.PONG, b"")
            case RequestHousekeeping():
                self._answers.put(MessageKind.HOUSEKEEPING, self.report().encode())
            case _:
                raise ValueError(f"{request!r} has no effect here")

    def take_commands(self) -> tuple[str, ...]:
        """Return the telecommands executed since the last call, as text; of too many, the last."""
        executed = tuple(self._executed)
        self._executed.clear()
        return executed

    def report(self) -> Housekeeping:
        """Return the housekeeping report; its rates are since the last one."""
        c, answers = self.counters, self._answers
        selection = self._path.selection
        offered_hz, sent_hz = self._reporter.rates_hz(self._time.now_us, c)
        return Housekeeping(
            t_us=self.own_us,
            region=(selection.x, selection.y, selection.width, selection.height),
            mode=Mode.STREAMING if self.streaming else Mode.STOPPED,
            time_status=self._time.status,
            offered_hz=offered_hz,
            sent_hz=sent_hz,
            temperature_centi_c=round(100 * self.settings.temperature_c),
            tick_us=self._path.tick_us,
            rate_limit_hz=self._path.rate_limit,
            events=_events(c),
            edges=EdgeCounts(c.edges.offered, c.edges.delivered, c.edges.ignored, c.edges.dropped_for_room),
            link=LinkCounts(answers.taken, answers.refused, self.frames_refused, answers.missing),
        )

    def _drop_before_zero(self) -> None:
        """Drop everything that waits if a part of it would have a negative time."""
        waiting_us = [us for us in (self._path.queue.oldest_us, self._edges.oldest_us) if us is not None]
        if min(waiting_us, default=self._time.now_us) < self._time.epoch_us:
            self._clear()

    def _clear(self) -> None:
        self._flush(self._path)
        self._flush(self._edges)
