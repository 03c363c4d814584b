"""Feed of a device in a link's process: events, edges and readings in time order, in the time that its clock shows.

    EventRing   --+
    EdgeSource  --+--> [device clock] --> device.offer_edges, offer_readings, offer, advance
    ReadingRing --+

The edges and readings of a stretch of time enter before its events. An edge that arrives after the device's time has
passed it is late; a device that stamps edges itself stamps it with the current time. Delays are counted for any device.

`ReadingFeed` moves readings from their rings into the device, and the settings of the device's host back.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from firmware_protocol.device.clock import ClockSettings, DeviceClock
from firmware_protocol.device.event_device import EventDevice, HasClockInput, StartsSilent, TakesReadings
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.events import EdgeKind, Edges, Events, copy_events, empty_edges, make_edges
from transports.link.edges import EdgeRing, EdgeSource
from transports.link.rings import FOREVER_US, EventRing, ReadingRing


@dataclass(frozen=True)
class ReadingReport:
    """Counts of the readings of one kind before the device; their fates in the device are in its own counters.

    Attributes
    ----------
    taken : readings offered to the device.
    ignored : readings offered to a device that does not use them.
    refused : readings for which the ring had no room.
    left : readings in the ring at the end of the run.
    """

    taken: int = 0
    ignored: int = 0
    refused: int = 0
    left: int = 0


class ReadingFeed:
    """Feed of readings of every kind; rings contain stream time, the device receives clock time."""

    def __init__(self, device: EventDevice, rings: Sequence[ReadingRing], clock: DeviceClock | None) -> None:
        self._device = device if isinstance(device, TakesReadings) else None
        self._rings = rings
        self._clock = clock
        self._version: int | None = None
        self._taken: Counter[ReadingKind] = Counter()
        self._ignored: Counter[ReadingKind] = Counter()

    def offer(self, until_us: int) -> None:
        """Offer the readings due up to stream time `until_us`, and send the host's settings to the session."""
        if self._device is not None and self._device.settings_version != self._version:
            self._version = self._device.settings_version
            for ring in self._rings:
                ring.write_settings(self._device.reading_settings(ring.kind))
        for ring in self._rings:
            records = ring.take(until_us)
            if not len(records):
                continue
            if self._clock is not None:
                records["t"] = self._clock.shown_us(records["t"])
            used = self._device is not None and self._device.offer_readings(ring.kind, records)
            (self._taken if used else self._ignored)[ring.kind] += len(records)

    @property
    def first_us(self) -> int | None:
        """Stream time of the first waiting reading; None if none waits."""
        return min((t_us for ring in self._rings if (t_us := ring.time_of(0)) is not None), default=None)

    def until_us(self, until_us: int) -> int:
        """Return the stream time, at most `until_us`, up to which readings find room in the device."""
        if self._device is None:
            return until_us
        for ring in self._rings:
            first_without_us = ring.time_of(self._device.room_readings(ring.kind))
            if first_without_us is not None:
                until_us = min(until_us, first_without_us - 1)
        return until_us

    @property
    def waiting(self) -> int:
        """Number of readings that wait in the rings."""
        return sum(ring.waiting for ring in self._rings)

    def reports(self, *, final: bool) -> Mapping[str, ReadingReport]:
        """Return the counts of readings before the device, by kind; at the end, those in the ring count as left."""
        return {
            str(ring.kind): ReadingReport(
                self._taken[ring.kind], self._ignored[ring.kind], ring.refused, ring.waiting if final else 0
            )
            for ring in self._rings
        }


@dataclass(frozen=True)
class Timing:
    """Time and trigger settings of a link.

    Attributes
    ----------
    edges : source of the edges at the device's external input; None if nothing is connected.
    holdback_us : delay between an event's time and its feeding, so that edges received late still enter in order.
    clock, seed : errors of the device's own clock; None: it shows stream time.
    truth : file for the true readings of that clock: monotonic ns, stream us, device us, ten lines a second.
    send_period_us : above 0, the device sends a mark of its own when its time is a multiple of this.
    sync_out, sync_in
        Cable between two cameras: the master writes its timestamp resets to `sync_out`, its slave reads `sync_in`.
    syncs : ring for the SYNCs of this link's bus to the session, when they drive the run.
    """

    edges: EdgeSource | None = None
    holdback_us: int = 0
    clock: ClockSettings | None = None
    seed: int = 0
    truth: Path | None = None
    send_period_us: int = 0
    syncs: EdgeRing | None = None
    sync_out: tuple[EdgeRing, ...] = ()
    sync_in: EdgeRing | None = None


@dataclass(frozen=True)
class EdgeReport:
    """Counts of the edges before the device; their fates in the device are in its own counters.

    Attributes
    ----------
    taken : edges offered to the device.
    late, worst_late_us : number of taken edges whose time had passed in the device, and the largest delay.
    left : edges that were received and not offered at the end of the run, or found the ring full.
    marks, marks_sent : number of the device's own marks, and of those that its link could send.
    """

    taken: int = 0
    late: int = 0
    worst_late_us: int = 0
    left: int = 0
    marks: int = 0
    marks_sent: int = 0


@dataclass(frozen=True)
class ClockReport:
    """Error of the device's clock at stream time `t_us`.

    Attributes
    ----------
    offset_us : clock reading less stream time, without any reset of the clock.
    ppm : rate error; positive if the clock is fast.
    epoch_us : clock reading, without resets, at the last reset by its host or by a restart.
    """

    t_us: int
    offset_us: float
    ppm: float
    epoch_us: int = 0

    @property
    def device_us(self) -> float:
        """Time that a receiver saw."""
        return self.t_us + self.offset_us - self.epoch_us


class Feed:
    """Feed of a device and of its `readings`; rings contain stream time, the device receives clock time."""

    def __init__(
        self, device: EventDevice, ring: EventRing, timing: Timing, readings: Sequence[ReadingRing] = ()
    ) -> None:
        self._device = device
        self._ring = ring
        self._edges = timing.edges
        self._sync_out, self._sync_in = timing.sync_out, timing.sync_in
        self.clock = None if timing.clock is None else DeviceClock(timing.clock, timing.seed)
        self.readings = ReadingFeed(device, readings, self.clock)
        restarts_s = () if timing.clock is None else timing.clock.restarts_s
        self._restarts_us = sorted(round(at_s * 1e6) for at_s in restarts_s)
        self._period_us = timing.send_period_us
        self._last_mark = 0
        self._marks = 0
        self.marks_sent = 0
        self._fed = 0
        self._taken = self._late = self._worst_late_us = 0
        self.reached_us = 0

    @property
    def due_us(self) -> int:
        """Stream time of the first event, edge or reading to feed, as far as it is known here."""
        edges_us = None if self._edges is None else self._edges.next_us
        times = (self._ring.next_us, edges_us, self.readings.first_us)
        return min((t_us for t_us in times if t_us is not None), default=FOREVER_US)

    @property
    def restart_us(self) -> int:
        """Stream time of the next restart of the device's clock."""
        return self._restarts_us[0] if self._restarts_us else FOREVER_US

    @property
    def has_edges_of_others(self) -> bool:
        """True if edges may come at any time, from another process, beside the events."""
        return self._sync_in is not None or isinstance(self._edges, EdgeRing)

    def feed(self, until_us: int, limit: int) -> int:
        """Move the data due up to stream time `until_us`, at most `limit` events in a stretch; return their number."""
        before = self._fed
        while self._restarts_us and self._restarts_us[0] <= until_us:
            if not self._stretch(self._restarts_us[0], limit):
                return self._fed - before
            del self._restarts_us[0]
            if isinstance(self._device, HasClockInput) and self._device.restart_clock():
                self._last_mark = 0
        self._stretch(until_us, limit)
        self._synchronise()
        return self._fed - before

    def happen(self, kind: EdgeKind | None) -> None:
        """Apply an edge to the input now, at the device's current time; None: reset the clock to zero."""
        if kind is None:
            if isinstance(self._device, HasClockInput):
                self._device.restart_clock()
            return
        self._taken += 1
        self._device.offer_edges(make_edges(self._device.now_us, kind))

    def _synchronise(self) -> None:
        """Send resets to a slave, or apply those of a master that this device's time has reached."""
        if not isinstance(self._device, HasClockInput) or (self._sync_in is None and not self._sync_out):
            return
        if self._sync_in is not None:
            for edge in self._sync_in.take(self._device.now_us):
                self._device.follow_reset(int(edge["t"]))
        for at_us in self._device.take_resets() if self._sync_out else ():
            reset = empty_edges(1)
            reset["t"] = at_us
            for ring in self._sync_out:
                ring.push(reset)

    def _stretch(self, until_us: int, limit: int) -> bool:
        """Feed one stretch; return False when there were more events than `limit`."""
        events = self._ring.take(until_us, limit)
        self._fed += len(events)
        complete = len(events) < limit
        # After a cut batch the device's time must not pass the events that still wait in the ring.
        reached_us = until_us if complete else max(int(events["t"][-1]) if len(events) else 0, self.reached_us)
        if self._edges is not None:
            self._offer_edges(self._edges.take(reached_us))
        self.readings.offer(reached_us)
        if len(events):
            self._device.offer(self._own_time(events))
        if complete:
            self._device.advance(self._shown_us(until_us))
        self.reached_us = max(self.reached_us, reached_us)
        return complete

    def _offer_edges(self, edges: Edges) -> None:
        if not len(edges):
            return
        if self.clock is not None:
            edges["t"] = self.clock.shown_us(edges["t"])
        late_us = self._device.now_us - edges["t"].astype(np.int64)
        self._late += int(np.count_nonzero(late_us > 0))
        self._worst_late_us = max(self._worst_late_us, int(late_us.max()))
        self._taken += len(edges)
        self._device.offer_edges(edges)

    def _own_time(self, events: Events) -> Events:
        if self.clock is None:
            return events
        shown = copy_events(events)
        shown["t"] = self.clock.shown_us(events["t"])
        return shown

    def _shown_us(self, stream_us: int) -> int:
        return stream_us if self.clock is None else int(self.clock.shown_us(stream_us)[0])

    @property
    def horizon_us(self) -> int:
        """Stream time to which the device can be advanced now without dropping waiting data, to 2 us.

        The time of data for which the FIFO has no room is not reached. The end of a silence is reached, or it would
        never end.
        """
        horizon_us = self._device.horizon_us
        if self.clock is None or horizon_us > self._shown_us(self.reached_us) + 3_600_000_000:
            return horizon_us
        silent = isinstance(self._device, StartsSilent) and self._device.now_us < self._device.silent_until_us
        return int(self.clock.stream_us(np.array([horizon_us]), self.reached_us)[0]) + (2 if silent else -2)

    def own_marks(self) -> Edges:
        """Return the marks that the device has made since the last call, (n,) EDGE in the time its receivers see."""
        if not self._period_us:
            return empty_edges()
        last = (self._device.now_us - self._device.epoch_us) // self._period_us
        first, self._last_mark = self._last_mark + 1, max(self._last_mark, last)
        numbers = np.arange(first, last + 1)
        self._marks += len(numbers)
        return make_edges(numbers * self._period_us, EdgeKind.PULSE, seq=numbers & 0xFFFF)

    def edge_report(self, *, final: bool = False) -> EdgeReport:
        """Return the counts of edges before the device; at the end, edges still to come count as left."""
        lost = 0
        if self._edges is not None:
            lost = self._edges.refused + (len(self._edges.take(self._ring.now_us)) if final else 0)
        return EdgeReport(self._taken, self._late, self._worst_late_us, lost, self._marks, self.marks_sent)

    def clock_report(self) -> ClockReport | None:
        """Return the error of the clock at the device's time; None for a device that shows stream time."""
        if self.clock is None:
            return None
        t_us = self.reached_us
        shown_us = float(self.clock.shown_ns(t_us * 1000)[0]) / 1000
        return ClockReport(t_us, round(shown_us - t_us, 3), self.clock.ppm(t_us), self._device.epoch_us)
