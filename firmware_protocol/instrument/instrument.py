"""An event camera on a narrow link: events and edges in, messages out, telecommands in. Sans-I/O.

    offer -------> selection -> queue --+
    offer_edges -> edges ---------------+--> next_message --> Outgoing -+-> sent
    advance -----> housekeeping due ----+         ^                     +-> lost
    command -----> verification, pong, time report

A message is formed when the link requests it, as late as possible: a link with spare capacity takes small recent
blocks, a busy one takes full blocks. Answers are sent first, then edges, housekeeping, events.

The camera's own time is stream time plus an offset that SetTime changes; all outgoing times are own times.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from firmware_protocol.device.event_device import EventDevice
from firmware_protocol.device.fates import Fates
from firmware_protocol.device.items import Items
from firmware_protocol.events import Edges, Events
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


@dataclass(frozen=True)
class Outgoing(Items):
    """A message, and the items in it as a receiver decodes them: rounded to the tick and in the order of the block.

    Attributes
    ----------
    message
        Message to send, with the instrument's own time. Its payload is empty if the link packs the events itself.
    dropped
        Events dropped between these and those sent before.
    """

    message: Message = field(kw_only=True)
    dropped: int = 0


class Instrument(EventDevice):
    """The camera.

    Parameters
    ----------
    size
        (width, height) of the array.
    biases
        Biases of its sensor; by default those of a DAVIS346.

    Attributes
    ----------
    frames_refused
        Damaged frames that the link received; the link sets it, housekeeping reports it.

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
        self._fates = Fates()
        self._path = EventPath(size, settings, self._fates)
        self._edges = EdgePath(BlockEncoder(size, block_settings(settings)), self._fates.edges)
        self._time = OwnTime()
        self._answers = Answers(self._time)
        self._telecommands = TelecommandHandler(self, self._answers, self._time)
        self._reporter = Reporter(round(settings.housekeeping_s * 1e6))
        self._started, self._connected = settings.autostart, True
        self._biases: SensorBiases = biases or DavisBiases()
        self._settings_version = 0
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
        """True while events offered now would be sent."""
        return self._started and self._connected

    @property
    def at_rest(self) -> bool:
        """True while no receiver is present."""
        return not self._connected

    @property
    def settings_version(self) -> int:
        """Number of telecommands and of biases that were set."""
        return self._settings_version

    @property
    def room_events(self) -> int:
        """Events that certainly fit the queue now."""
        return self._path.room

    @property
    def horizon_us(self) -> int:
        """Stream time to which the camera can advance now before a waiting event reaches its age limit."""
        patience_us = self._path.patience_us if self.streaming else None
        if patience_us is None:
            return super().horizon_us
        oldest_us = self._path.oldest_us
        return patience_us + (self._time.now_us if oldest_us is None else oldest_us)

    @property
    def counters(self) -> Fates:
        """Fates of all events and edges offered so far."""
        return self._fates.waiting(self._path.waiting, self._edges.waiting)

    @property
    def delivered(self) -> int:
        """See `EventDevice.delivered`."""
        return self._fates.delivered

    @property
    def waiting_items(self) -> int:
        """See `EventDevice.waiting_items`."""
        return self._fates.all_queued + self._path.waiting + self._edges.waiting

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
        self._fates.offered += len(events)
        if self.streaming:
            self._path.put(events, self._time.now_us, self._time.offset_us)
        else:
            self._fates.not_running += len(events)

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

    def set_tick(self, tick_us: int) -> None:
        """Set the unit of time from the next block on."""
        self._path.set_tick(tick_us)

    def set_region(self, x: int, y: int, width: int, height: int) -> None:
        """Send events of these pixels only from now on; raises ValueError if they lie outside the array."""
        self._path.select(Selection(x, y, width, height, self._path.selection.keep_every))

    def set_rate_limit(self, events_per_s: int) -> None:
        """Limit the rate from now on; 0 for no limit."""
        self._path.limit(events_per_s, self._time.now_us)

    def set_bias(self, bias: int, value: int) -> None:
        """Set a bias by its number; raises ValueError for a number or a value that the sensor does not have."""
        self._settings_version += 1
        self._biases.set(bias, value)

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
        return self._outgoing(self._path.next_block(self._time.offset_us)) if events else None

    def next_edges(self) -> Outgoing | None:
        """Hand out the waiting edges; otherwise as `next_message`."""
        found = self._edges.next_block(self._time.offset_us)
        if found is None:
            return None
        block, carried = found
        message = Message(MessageKind.EDGES, block, self._time.of(int(carried["t"][0])))
        return Outgoing(edges=carried, epoch_us=self.epoch_us, message=message)

    def next_events(self, limit: int) -> Outgoing | None:
        """Hand out up to `limit` events for a link that packs them itself; otherwise as `next_message`."""
        return self._outgoing(self._path.next_events(limit))

    def sent(self, outgoing: Outgoing) -> None:
        """Count an outgoing message as sent: its events are delivered."""
        self._fates.leave(outgoing, "delivered")

    def lost(self, outgoing: Outgoing) -> None:
        """Count an outgoing message as lost by the link."""
        self._fates.leave(outgoing, "lost_on_link")

    def command(self, received: ReceivedCommand) -> None:
        """Execute a telecommand, and answer as PUS service 1 does."""
        self._settings_version += 1
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
        return Outgoing(piece.events, epoch_us=self.epoch_us, message=message, dropped=piece.dropped)

    def _drop_before_zero(self) -> None:
        """Drop everything that waits if a part of it would have a negative time."""
        waiting_us = [us for us in (self._path.oldest_us, self._edges.oldest_us) if us is not None]
        if min(waiting_us, default=self._time.now_us) < self._time.epoch_us:
            self._clear()

    def _clear(self) -> None:
        self._path.clear()
        self._edges.clear()
