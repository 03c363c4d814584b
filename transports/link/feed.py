"""What goes into a device in a link's process: events, edges and readings in time order, in the device's own time.

    EventRing   --+
    EdgeSource  --+--> [device clock] --> device.offer_edges, offer_readings, offer, advance
    ReadingRing --+

Edges and readings of a stretch of time go in before its events. An edge that comes when the device's time has passed it
is late: a device that stamps by itself stamps it now. How late is counted, for any device.

What goes from the rings of readings into a device, in the device's own time, and what its host asks back.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from firmware_protocol.device.clock import ClockSettings, DeviceClock
from firmware_protocol.device.event_device import EventDevice, ReadingKind
from firmware_protocol.events import EdgeKind, Edges, Events, copy_events, empty_edges
from transports.link.edges import EdgeRing, EdgeSource
from transports.link.rings import EventRing, ReadingRing
from transports.output_file import OutputFile

__all__ = ["ClockReport", "ClockTruth", "EdgeReport", "Feed", "ReadingFeed", "ReadingReport", "Timing"]


@dataclass(frozen=True)
class ReadingReport:
    """Readings of one kind before the device; their fates in it are its own counters'.

    Attributes
    ----------
    taken
        Were offered to the device.
    ignored
        Were offered to a device that has no use for them.
    refused
        Found the ring full.
    left
        Were in the ring when the run ended.
    """

    taken: int = 0
    ignored: int = 0
    refused: int = 0
    left: int = 0


class ReadingFeed:
    """Moves readings of every kind. Stream time outside, device time inside."""

    def __init__(self, device: EventDevice, rings: Sequence[ReadingRing], clock: DeviceClock | None) -> None:
        self._device = device
        self._rings = rings
        self._clock = clock
        self._taken: Counter[ReadingKind] = Counter()
        self._ignored: Counter[ReadingKind] = Counter()

    def offer(self, until_us: int) -> None:
        """Give the device what is due up to stream time `until_us`, and hear what its host asks."""
        for ring in self._rings:
            ring.tell(self._device.reading_settings(ring.kind))
            records = ring.take(until_us)
            if not len(records):
                continue
            if self._clock is not None:
                records["t"] = self._clock.shown_us(records["t"])
            used = self._device.offer_readings(ring.kind, records)
            (self._taken if used else self._ignored)[ring.kind] += len(records)

    def until_us(self, until_us: int) -> int:
        """Return how far stream time may go, at most to `until_us`, before readings find no room in the device."""
        for ring in self._rings:
            first_without_us = ring.time_of(self._device.room_readings(ring.kind))
            if first_without_us is not None:
                until_us = min(until_us, first_without_us - 1)
        return until_us

    @property
    def waiting(self) -> int:
        """Readings that wait in the rings."""
        return sum(ring.waiting for ring in self._rings)

    def reports(self, *, final: bool) -> Mapping[str, ReadingReport]:
        """Return what became of readings before the device, by kind; at the end, those in the ring count as left."""
        return {
            str(ring.kind): ReadingReport(
                self._taken[ring.kind], self._ignored[ring.kind], ring.refused, ring.waiting if final else 0
            )
            for ring in self._rings
        }


@dataclass(frozen=True)
class Timing:
    """What a link has to do with time and triggers.

    Attributes
    ----------
    edges
        What happens on the device's external input; None where nothing is connected.
    holdback_us
        How long after its time an event is fed, so that edges that are heard late still enter in order.
    clock, seed
        How the device's own clock goes wrong; None: it shows stream time.
    truth
        File for what that clock really shows: monotonic ns, stream us, device us, ten lines a second.
    send_period_us
        Above 0, the device says by a mark of its own when its time is a multiple of this.
    sync_out, sync_in
        The cable between two cameras: where the master tells of its timestamp resets, and where its slave hears.
    syncs
        Where the session hears of the SYNCs of this link's bus, when these drive the run.
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
    """Edges on their way to the device; their fates in it are its own counters'.

    Attributes
    ----------
    taken
        Were offered to the device.
    late, worst_late_us
        Of those, came after their time had passed in the device, and by how much at worst.
    left
        Were heard and not offered when the run ended, or found the ring full.
    marks, marks_sent
        The device's own that it made, and those that its link could send.
    """

    taken: int = 0
    late: int = 0
    worst_late_us: int = 0
    left: int = 0
    marks: int = 0
    marks_sent: int = 0


@dataclass(frozen=True)
class ClockReport:
    """How wrong the device's clock was at stream time `t_us`.

    Attributes
    ----------
    offset_us
        What it showed less stream time, had nobody ever set it to zero.
    ppm
        How much too fast it ran.
    epoch_us
        What it would have shown when it was last set to zero, by its host or by a restart.
    """

    t_us: int
    offset_us: float
    ppm: float
    epoch_us: int = 0

    @property
    def device_us(self) -> float:
        """What a receiver saw."""
        return self.t_us + self.offset_us - self.epoch_us


class ClockTruth:
    """A file of what a device's clock really shows, for whoever scores an estimator."""

    def __init__(self, path: Path) -> None:
        self._file = OutputFile(path, "truth")
        self._file.write(b"monotonic_ns,stream_us,device_us\n")

    @property
    def trouble(self) -> str:
        """Why the file is not whole, for people; empty where it is."""
        return self._file.trouble

    def add(self, monotonic_ns: int, report: ClockReport) -> None:
        """Write one line."""
        self._file.write(f"{monotonic_ns},{report.t_us},{report.device_us:.3f}\n".encode("ascii"))

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Feed:
    """Feeds a device. Stream time outside, device time inside.

    Attributes
    ----------
    readings
        What is fed beside events and edges.
    """

    def __init__(
        self, device: EventDevice, ring: EventRing, timing: Timing, readings: Sequence[ReadingRing] = ()
    ) -> None:
        self._device = device
        self._ring = ring
        self._edges = timing.edges
        self._sync_out, self._sync_in = timing.sync_out, timing.sync_in
        self.clock = None if timing.clock is None else DeviceClock(timing.clock, timing.seed)
        self.readings = ReadingFeed(device, readings, self.clock)
        self._restarts_us = [] if self.clock is None else self.clock.restarts_us
        self._period_us = timing.send_period_us
        self._last_mark = 0
        self._marks = 0
        self.marks_sent = 0
        self._taken = self._late = self._worst_late_us = 0
        self.reached_us = 0

    def feed(self, until_us: int, limit: int) -> None:
        """Move what is due up to stream time `until_us`, at most `limit` events at a stretch."""
        while self._restarts_us and self._restarts_us[0] <= until_us:
            if not self._stretch(self._restarts_us[0], limit):
                return
            del self._restarts_us[0]
            if self._device.restart_clock():
                self._last_mark = 0
        self._stretch(until_us, limit)
        self._synchronise()

    def happen(self, kind: EdgeKind | None) -> None:
        """Let an edge come to the input now, where device time has got to; None: the clock starts anew at zero."""
        if kind is None:
            self._device.restart_clock()
            return
        edge = empty_edges(1)
        edge["t"], edge["kind"] = self._device.now_us, kind
        self._taken += 1
        self._device.offer_edges(edge)

    def _synchronise(self) -> None:
        """Tell a slave of resets, or follow those of a master that this device's time has reached."""
        if self._sync_in is not None:
            for edge in self._sync_in.take(self._device.now_us):
                self._device.follow_reset(int(edge["t"]))
        for at_us in self._device.take_resets() if self._sync_out else ():
            told = empty_edges(1)
            told["t"] = at_us
            for ring in self._sync_out:
                ring.push(told)

    def _stretch(self, until_us: int, limit: int) -> bool:
        """Feed one stretch; False when there were more events than `limit`."""
        events = self._ring.take(until_us, limit)
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
        own = copy_events(events)
        own["t"] = self.clock.shown_us(events["t"])
        return own

    def _shown_us(self, stream_us: int) -> int:
        return stream_us if self.clock is None else int(self.clock.shown_us(stream_us)[0])

    @property
    def horizon_us(self) -> int:
        """Stream time to which the device can be advanced now without dropping what waits, to 2 us.

        What the FIFO has no room for is not reached; the end of a silence is, or it would never come.
        """
        horizon_us = self._device.horizon_us
        if self.clock is None or horizon_us > self._shown_us(self.reached_us) + 3_600_000_000:
            return horizon_us
        silent = self._device.now_us < self._device.silent_until_us
        return int(self.clock.stream_us(np.array([horizon_us]), self.reached_us)[0]) + (2 if silent else -2)

    def own_marks(self) -> Edges:
        """Return the marks that the device has made since the last call, (n,) EDGE in the time its receivers see."""
        if not self._period_us:
            return empty_edges()
        last = (self._device.now_us - self._device.epoch_us) // self._period_us
        first, self._last_mark = self._last_mark + 1, max(self._last_mark, last)
        numbers = np.arange(first, last + 1)
        self._marks += len(numbers)
        marks = empty_edges(len(numbers))
        marks["t"], marks["kind"], marks["seq"] = numbers * self._period_us, EdgeKind.PULSE, numbers & 0xFFFF
        return marks

    def edge_report(self, *, final: bool = False) -> EdgeReport:
        """Return what became of edges before the device; at the end, those still to come count as left."""
        lost = 0
        if self._edges is not None:
            lost = self._edges.refused + (len(self._edges.take(self._ring.now_us)) if final else 0)
        return EdgeReport(self._taken, self._late, self._worst_late_us, lost, self._marks, self.marks_sent)

    def clock_report(self) -> ClockReport | None:
        """Return how wrong the clock is where the device has got to; None for a device that shows stream time."""
        if self.clock is None:
            return None
        t_us = self.reached_us
        shown_us = float(self.clock.shown_ns(t_us * 1000)[0]) / 1000
        return ClockReport(t_us, round(shown_us - t_us, 3), self.clock.ppm(t_us), self._device.epoch_us)
