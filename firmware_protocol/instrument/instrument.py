"""An event camera without USB: events and edges in, messages out, telecommands in. Sans-I/O.

    offer -------> selection -> queue --+
    offer_edges -> edges ---------------+--> next_message --> Outgoing -+-> sent
    advance -----> housekeeping due ----+         ^                     +-> lost
    command -----> verification, pong, time report

A message is formed when the line asks for it, as late as possible: a line that is wide takes small fresh blocks, a line
that is full takes full ones. Answers go first, then edges, housekeeping, events.

The camera's own time is stream time plus an offset that SetTime changes; all that leaves bears it.

Housekeeping: when it is due, and what it says.

What leaves an instrument.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from firmware_protocol.device.event_device import CameraCounters, EventDevice
from firmware_protocol.events import Edges, Events, empty_edges, empty_events
from firmware_protocol.instrument.event_path import EdgePath, EventPath, Piece, block_settings
from firmware_protocol.instrument.queue import OwnTime, Selection
from firmware_protocol.instrument.settings import DavisBiases, InstrumentSettings, SensorBiases
from firmware_protocol.instrument.telecommand_handler import Answers, TelecommandHandler
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.housekeeping import EdgeCounts, EventCounts, Housekeeping, LinkCounts, Mode, TimeStatus
from firmware_protocol.packets.profile import ReceivedCommand
from firmware_protocol.telemetry import BlockEncoder

__all__ = ["Instrument", "Outgoing", "Reporter", "State"]


_MOST_HZ = 0xFFFF_FFFF


@dataclass(frozen=True)
class State:
    """What an instrument has to tell of itself; `now_us` is stream time, `own_us` the camera's."""

    now_us: int
    own_us: int
    streaming: bool
    time_status: TimeStatus
    tick_us: int
    rate_limit: int
    selection: Selection
    temperature_c: float
    counters: CameraCounters
    link: LinkCounts


class Reporter:
    """Makes housekeeping reports, one every `period_us` of stream time; with 0 only those that are asked for."""

    def __init__(self, period_us: int) -> None:
        self._period_us = period_us
        self._next_us = 0
        self._last_us = self._offered = self._sent = 0

    def due(self, now_us: int) -> bool:
        """Say whether the next report is due."""
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
            edges=EdgeCounts(c.edges.offered, c.edges.delivered, c.edges.ignored, c.edges.dropped),
            link=state.link,
        )


def _events(c: CameraCounters) -> EventCounts:
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


@dataclass(frozen=True)
class Outgoing:
    """A message, and what it carries as a receiver will see it.

    Attributes
    ----------
    message
        What to send, with the instrument's own time. Its payload is empty where the link packs the events itself.
    events, edges
        What it carries, in stream time: cut to the tick and in the order of the block.
    epoch_us
        Stream time at which the instrument's own time is zero; negative where that is before the stream began.
    dropped
        Events dropped between these and those that left before.
    """

    message: Message
    events: Events = field(default_factory=empty_events)
    edges: Edges = field(default_factory=empty_edges)
    epoch_us: int = 0
    dropped: int = 0


class Instrument(EventDevice):
    """The camera.

    Parameters
    ----------
    size
        (width, height) of the array.
    biases
        Of its sensor; those of a DAVIS346 where none are given.

    Attributes
    ----------
    frames_refused
        Damaged frames that the link has seen; the link sets it, housekeeping tells it.

    Raises
    ------
    ValueError
        The settings do not fit the array.
    """

    set_by = "telecommand"

    def __init__(
        self, size: tuple[int, int], settings: InstrumentSettings | None = None, biases: SensorBiases | None = None
    ) -> None:
        self.settings = settings = settings or InstrumentSettings()
        self._path = EventPath(size, settings)
        self._edges = EdgePath(BlockEncoder(size, block_settings(settings)))
        self._time = OwnTime()
        self._answers = Answers(self._time)
        self._telecommands = TelecommandHandler(self, self._answers, self._time)
        self._reporter = Reporter(round(settings.housekeeping_s * 1e6))
        self._started, self._connected = settings.autostart, True
        self._biases: SensorBiases = biases or DavisBiases()
        self.frames_refused = 0

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
        """True while events offered now would go to the line."""
        return self._started and self._connected

    @property
    def room_events(self) -> int:
        """Events that certainly fit the queue now."""
        return self._path.room

    @property
    def horizon_us(self) -> int:
        """Stream time to which it can be advanced now without an event's getting too old."""
        patience_us = self._path.patience_us if self.streaming else None
        if patience_us is None:
            return super().horizon_us
        oldest_us = self._path.oldest_us
        return patience_us + (self._time.now_us if oldest_us is None else oldest_us)

    @property
    def counters(self) -> CameraCounters:
        """Fates of all events and edges offered so far."""
        f = self._path.fates
        return CameraCounters(
            offered=f.offered,
            not_running=f.not_running,
            dropped_fifo=f.dropped_fifo,
            flushed=f.flushed,
            delivered=f.delivered,
            lost_on_link=f.lost_on_link,
            queued=self._path.waiting + self._path.in_flight,
            not_selected=f.not_selected,
            dropped_rate=f.dropped_rate,
            dropped_late=f.dropped_late,
            edges=self._edges.counters,
        )

    def offer(self, events: Events) -> None:
        """See `EventDevice.offer`."""
        if not len(events):
            return
        if int(events["t"][0]) < self._time.now_us:
            raise ValueError(
                f"event at {events['t'][0]} us offered after the camera's clock reached {self._time.now_us} us"
            )
        self._path.check(events)
        self._time.reach(int(events["t"][-1]))
        self._path.fates.offered += len(events)
        if self.streaming:
            self._path.put(events, self._time.now_us, self._time.offset_us)
        else:
            self._path.fates.not_running += len(events)

    def offer_edges(self, edges: Edges) -> None:
        """See `EventDevice.offer_edges`."""
        seen = self.streaming and not (edges["t"].astype(np.int64) + self._time.offset_us < 0).any()
        (self._edges.put if seen else self._edges.ignore)(edges)

    def advance(self, now_us: int) -> None:
        """See `EventDevice.advance`."""
        self._time.reach(now_us)
        self._path.advance(self._time.now_us)

    @property
    def sensor_factors(self) -> Mapping[str, float]:
        """What the commanded biases do to the pixels; empty before the first."""
        return self._biases.factors

    @property
    def without_effect(self) -> Mapping[str, str]:
        """Commanded biases that change nothing in the sensor, and why."""
        return self._biases.without_effect

    @property
    def biases(self) -> Mapping[int, int]:
        """Biases by number, as commanded; see `instrument.biases`."""
        return self._biases.values

    def connected(self) -> None:
        """Somebody listens on the line; so it is from the beginning, unless `disconnected` says otherwise."""
        self._connected = True

    def disconnected(self) -> None:
        """Nobody listens: what waits is dropped, and what comes counts as not running."""
        self._connected = False
        self._answers.clear()
        self._clear()

    def start(self) -> None:
        """Let events flow."""
        self._started = True

    def stop(self) -> None:
        """Let no events flow, and drop what waits."""
        self._started = False
        self._clear()

    def set_time(self, t_us: int) -> None:
        """Say that the camera's own time is now `t_us`; raises ValueError when that is too far in the future."""
        self._time.set(t_us)
        self._drop_before_zero()

    @property
    def epoch_us(self) -> int:
        """Stream time at which the camera's own time is zero; negative when it was set ahead."""
        return self._time.epoch_us

    def restart_clock(self) -> bool:
        """Set the camera's own time to zero, unasked; what waits is dropped, for its times would be negative."""
        self._time.restart()
        self._drop_before_zero()
        return True

    def set_tick(self, tick_us: int) -> None:
        """Count time in another unit from the next block on."""
        self._path.set_tick(tick_us)

    def set_region(self, x: int, y: int, width: int, height: int) -> None:
        """Send events of these pixels only from now on; raises ValueError when they lie outside the array."""
        self._path.select(Selection(x, y, width, height, self._path.selection.keep_every))

    def set_rate_limit(self, events_per_s: int) -> None:
        """Keep to a rate from now on; 0 for none."""
        self._path.limit(events_per_s, self._time.now_us)

    def set_bias(self, bias: int, value: int) -> None:
        """Set a bias by its number; raises ValueError for a number or a value that the sensor does not have."""
        self._biases.set(bias, value)

    def next_message(self, *, events: bool = True, edges: bool = True) -> Outgoing | None:
        """Return what is to leave next, None when there is nothing; without what the link packs itself.

        `sent` or `lost` must follow for each, in the order of the calls.
        """
        if (answer := self._answers.take()) is not None:
            return Outgoing(answer)
        if edges and (outgoing := self.next_edges()):
            return outgoing
        if self._reporter.due(self._time.now_us):
            return Outgoing(Message(MessageKind.HOUSEKEEPING, self.report().encode(), self.own_us))
        return self._outgoing(self._path.next_block(self._time.offset_us)) if events else None

    def next_edges(self) -> Outgoing | None:
        """Hand out the edges that wait; otherwise as `next_message`."""
        found = self._edges.next_block(self._time.offset_us)
        if found is None:
            return None
        block, carried = found
        message = Message(MessageKind.EDGES, block, self._time.of(int(carried["t"][0])))
        return Outgoing(message, edges=carried, epoch_us=self.epoch_us)

    def next_events(self, limit: int) -> Outgoing | None:
        """Hand out up to `limit` events for a link that packs them itself; otherwise as `next_message`."""
        return self._outgoing(self._path.next_events(limit))

    def sent(self, outgoing: Outgoing) -> None:
        """Say that this has left: its events count as delivered."""
        self._path.sent(len(outgoing.events))
        self._edges.sent(len(outgoing.edges))

    def lost(self, outgoing: Outgoing) -> None:
        """Say that the link lost this."""
        self._path.lost(len(outgoing.events))
        self._edges.lost(len(outgoing.edges))

    def command(self, received: ReceivedCommand) -> None:
        """Do what a telecommand says, and answer as PUS service 1 does."""
        self._telecommands.handle(received)

    def take_commands(self) -> tuple[str, ...]:
        """See `EventDevice.take_commands`."""
        return self._telecommands.take_executed()

    def report(self) -> Housekeeping:
        """Return the housekeeping report; its rates are since the last one."""
        did = self._telecommands
        state = State(
            now_us=self._time.now_us,
            own_us=self.own_us,
            streaming=self.streaming,
            time_status=self._time.status,
            tick_us=self._path.tick_us,
            rate_limit=self._path.rate_limit,
            selection=self._path.selection,
            temperature_c=self.settings.temperature_c,
            counters=self.counters,
            link=LinkCounts(did.taken, did.refused, self.frames_refused, did.missing),
        )
        return self._reporter.report(state)

    def _outgoing(self, piece: Piece | None) -> Outgoing | None:
        if piece is None:
            return None
        message = Message(MessageKind.EVENTS, piece.block, self._time.of(int(piece.events["t"][0])))
        return Outgoing(message, piece.events, epoch_us=self.epoch_us, dropped=piece.dropped)

    def _drop_before_zero(self) -> None:
        """Drop all that waits if some of it would bear a negative time."""
        waiting_us = [us for us in (self._path.oldest_us, self._edges.oldest_us) if us is not None]
        if min(waiting_us, default=self._time.now_us) < self._time.epoch_us:
            self._clear()

    def _clear(self) -> None:
        self._path.clear()
        self._edges.clear()
