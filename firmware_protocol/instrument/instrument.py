"""An event camera without USB: events and edges in, messages out, telecommands in. Sans-I/O.

    offer -------> selection -> queue --+
    offer_edges -> edges ---------------+--> next_message --> Outgoing -+-> sent
    advance -----> housekeeping due ----+         ^                     +-> lost
    command -----> verification, pong, time report

A message is formed when the line asks for it, as late as possible: a line that is wide takes small fresh blocks, a line
that is full takes full ones. Answers go first, then edges, housekeeping, events.

The camera's own time is stream time plus an offset that SetTime changes; all that leaves bears it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from firmware_protocol.edges import Edges
from firmware_protocol.event_device import CameraCounters, EventDevice
from firmware_protocol.events import Events
from firmware_protocol.instrument.answers import Answers
from firmware_protocol.instrument.biases import DavisBiases, SensorBiases
from firmware_protocol.instrument.edge_path import EdgePath
from firmware_protocol.instrument.event_path import EventPath, Piece, block_settings
from firmware_protocol.instrument.outgoing import Outgoing
from firmware_protocol.instrument.own_time import OwnTime
from firmware_protocol.instrument.rate import Selection
from firmware_protocol.instrument.report import Reporter, State
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.instrument.telecommand_handler import TelecommandHandler
from firmware_protocol.packets.housekeeping import Housekeeping, LinkCounts
from firmware_protocol.packets.message import Message, MessageKind
from firmware_protocol.packets.profile import ReceivedCommand
from firmware_protocol.telemetry import BlockEncoder

__all__ = ["Instrument"]


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
