"""One link: an event device, the transport of its bytes, and their process.

    session process                      link process
    ---------------                      ------------------------------------------------
    EventRing  ---- events, now_us --->  feed: device.offer, device.advance
    ReadingRing --- frames, samples -->        device.offer_readings
               <--- host settings -----        device.reading_settings
    Connection ---- Stop, faults ------>  endpoint: USB/IP server, serial line ...
               <--- CameraSettings ----  changes by hosts, with their stream time (see `report`)
               <--- LinkReport --------  (ten a second, and a last one)

Each link has its own process, because a busy Python thread delays pacing of microseconds to tens of milliseconds. The
link determines the sending time of an event: its own time in a paced run, otherwise as soon as it is available.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from firmware_protocol.device.event_device import EventDevice, HostAdjusted, StartsSilent
from firmware_protocol.events import EdgeKind
from firmware_protocol.recordings.part import Facts
from transports.faults.kinds import Fault
from transports.link.deliveries import Deliveries, DeliveryTally, RecorderFactory
from transports.link.endpoint import BUSY_NS, HOSTED_NS, REST_NS, Endpoint, EndpointFactory
from transports.link.feed import ClockReport, Feed, Timing
from transports.link.pacing import Clock
from transports.link.report import ChangeWatch, LinkReport, Occurrence
from transports.link.rings import FOREVER_US, FREE_RUNNING, EventRing, ReadingRing
from transports.output_file import OutputFile

_TAKE_LIMIT = 1 << 17  # events a tick: bounds the memory and the time of one tick
_MANY_EVENTS = 1024  # a tick that fed so many, of a run without pacing, is followed by the next one at once
_DENSE_EVENTS = 256  # a paced tick that fed so many is followed by the next one after a whole millisecond
_GATHER_US = 100  # from the first due event to the tick that sends it, with those that follow
_WITHHELD_STEP_US = 1000  # step of a run without pacing during a silence: the silence ends at most this late

_NO_FACTS = Facts()

_Device = TypeVar("_Device", bound=EventDevice)


@dataclass(frozen=True)
class LinkSetup(Generic[_Device]):
    """Complete configuration of a link process.

    Attributes
    ----------
    device : Factory of the device, called in the link's process: `partial(Davis346, settings)` and the like, which can
        be pickled.
    timing : triggers, and the device's own clock.
    recorder, facts
        Recorder of the delivered data, and the camera's properties for its file; None: nothing is recorded.
    fifo_priority : above 0, the process runs under SCHED_FIFO, so that other processes cannot delay it.
    restart : True if the process is started again when it dies.
    tally : number of delivered events; the count remains after the process has ended.
    readings : rings of the readings of the device, one for each kind.
    """

    name: str
    ring: EventRing
    device: Callable[[], _Device]
    endpoint: EndpointFactory[_Device]
    recorder: RecorderFactory | None = None
    facts: Facts = _NO_FACTS
    tick_us: int = 500
    timing: Timing = field(default_factory=Timing)
    fifo_priority: int = 0
    restart: bool = False
    tally: DeliveryTally = field(default_factory=DeliveryTally)
    readings: tuple[ReadingRing, ...] = ()


class Link:
    """Event device that is fed from a ring and read by an endpoint. One tick moves all due data.

    `ring`: ring of its events; `ticked_ns`: start of the last tick; `changes`: those of the camera that have not been
    sent to the session, the oldest first.
    """

    def __init__(self, setup: LinkSetup[Any], clock: Clock) -> None:
        self.ring = setup.ring
        self._tally = setup.tally
        self._clock = clock
        self._period_ns = setup.tick_us * 1000
        self._device: EventDevice = setup.device()
        recorder = None if setup.recorder is None else setup.recorder.open(setup.facts)
        self._feed = Feed(self._device, setup.ring, setup.timing, setup.readings)
        self._watch = ChangeWatch(self._device)
        self.changes = self._watch.waiting
        self._holdback_us = setup.timing.holdback_us
        self._truth = None if setup.timing.truth is None else OutputFile(setup.timing.truth, "truth")
        if self._truth is not None:
            self._truth.write(b"monotonic_ns,stream_us,device_us\n")
        self._last_clock: ClockReport | None = None
        self._silence = -1, 0, 0  # end of the newest one, and the stream time and the time of its start
        self._deliveries = Deliveries(setup.ring, clock, recorder, self._feed.clock, setup.facts.imu_unit)
        self.endpoint: Endpoint = setup.endpoint.build(self._device, self._deliveries)
        self.ticked_ns = clock.now_ns()
        self._fed = 0
        self._seen_us = 0  # stream time of the run when the last tick began

    def tick(self) -> None:
        """Feed the due data to the camera, and let the endpoint send the requested data."""
        origin_ns, now_us = self.ring.origin_ns, self.ring.now_us  # read first: no data of a run, or of a time,
        self.endpoint.listen()  # that began after a request was made are fed before it
        self._advance(origin_ns, now_us)

    def attend(self) -> None:
        """Feed the camera up to now, before a request that arrived between two ticks is processed.

        A camera that a host reads may be half a millisecond behind, another one a tenth. Nothing is done in a run
        without pacing: all published data have been fed when the link sleeps.
        """
        behind_ns = self._clock.now_ns() - self.ticked_ns
        if self.is_paced and behind_ns >= (_GATHER_US * 1000 if self._device.at_rest else self._period_ns):
            self._advance(self.ring.origin_ns, self.ring.now_us)

    def _advance(self, origin_ns: int | None, now_us: int) -> None:
        """Move all data that are due, of a stream with the origin `origin_ns` that has reached `now_us`."""
        self.ticked_ns = self._clock.now_ns()
        self._watch.look(self._feed.reached_us, self.ticked_ns)
        self._seen_us = now_us
        self._fed = 0 if origin_ns is None else self._feed_due(origin_ns, now_us)
        if not self._watch.waiting:  # a session without pacing computes its next step while the endpoint sends
            self.settle()
        self.endpoint.advance_faults(self._feed.reached_us)
        marks = self._feed.own_marks()
        if len(marks):
            self._feed.marks_sent += self.endpoint.mark(marks)
        self.endpoint.pump()
        self._tally.delivered = self._device.delivered - sum(
            fault.events_lost for fault in self.endpoint.faulty.records
        )
        if self._deliveries.recording is not None and not self._device.waiting_items:
            self._deliveries.reach(self._device.now_us, self._device.epoch_us)

    def _feed_due(self, origin_ns: int, now_us: int) -> int:
        """Feed the due data; return the number of events."""
        if origin_ns == FREE_RUNNING:
            bounded = self._device.streaming and not self.endpoint.faulty.withholds
            room = self._device.room_events if bounded else _TAKE_LIMIT
            return self._feed.feed(self._free_until_us(now_us), min(room, _TAKE_LIMIT))
        due_us = (self._clock.now_ns() - origin_ns) // 1000 - self._holdback_us
        return 0 if due_us < 0 else self._feed.feed(min(due_us, now_us), _TAKE_LIMIT)

    @property
    def is_paced(self) -> bool:
        """True in a run whose events leave at their own time."""
        return self.ring.origin_ns not in (None, FREE_RUNNING)

    @property
    def is_at_rest(self) -> bool:
        """True while no host notices if data leave some milliseconds late."""
        return self._device.at_rest

    @property
    def soonest_ns(self) -> int:
        """Time of the next tick while data move."""
        return self.ticked_ns + self._period_ns

    @property
    def published_ns(self) -> int:
        """Time of the next tick after a publication: at once if an unpaced session waits for this camera's settings."""
        return self.soonest_ns if self.is_paced or not self._watch.acts else self.ticked_ns

    @property
    def next_ns(self) -> int:
        """Time at which the next tick is due if neither a request nor a publication comes before."""
        if self._watch.is_behind or self.endpoint.faulty.next_us <= self._feed.reached_us:
            return self.soonest_ns
        if not self.is_paced and self._lags:
            waited_for = self._watch.acts and self.ring.now_us > self._seen_us
            return self.ticked_ns if waited_for or self._fed >= _MANY_EVENTS else self.soonest_ns
        longest_ns = self._longest_sleep_ns
        latest_ns = self.ticked_ns + longest_ns
        if self._fed >= _DENSE_EVENTS and longest_ns == HOSTED_NS:
            return latest_ns
        return max(self.soonest_ns, min(latest_ns, self._due_ns))

    def asleep_us(self, until_ns: int) -> int:
        """Return the stream time until which a sleep until `until_ns` lasts; 0 if no publication need end it."""
        origin_ns = self.ring.origin_ns
        if origin_ns is None or origin_ns == FREE_RUNNING:
            return FOREVER_US
        return 0 if self.is_at_rest else max(0, (until_ns - origin_ns) // 1000 - self._holdback_us)

    @property
    def _lags(self) -> bool:
        """True if the camera has not reached the stream time of the run that has begun."""
        begun = self.ring.origin_ns is not None
        return begun and (self._feed.reached_us < self.ring.now_us or self.ring.waiting > 0)

    @property
    def _longest_sleep_ns(self) -> int:
        longest_ns = self.endpoint.longest_sleep_ns
        if not self.is_paced:  # time stands still between publications, which wake this process
            return REST_NS if longest_ns >= HOSTED_NS else longest_ns
        if self.is_at_rest:
            return min(longest_ns, REST_NS)
        return min(longest_ns, BUSY_NS if self._feed.has_edges_of_others else HOSTED_NS)

    @property
    def _due_ns(self) -> int:
        """Time at which the first data, fault or restart of the clock is due; never in a run that is not paced."""
        origin_ns = self.ring.origin_ns
        if origin_ns is None or origin_ns == FREE_RUNNING:
            return self.ticked_ns + REST_NS
        due_us = min(self.endpoint.faulty.next_us, self._feed.restart_us)
        if not self.is_at_rest:
            due_us = min(due_us, self._feed.due_us + _GATHER_US)
        return origin_ns + (due_us + self._holdback_us) * 1000

    def settle(self) -> None:
        """Report the stream time before which no change can come to the session, when all changes have been sent."""
        self.ring.settle(self._feed.reached_us if self._watch.acts else FOREVER_US)

    def inject(self, fault: Fault, by: str = "") -> None:
        """Begin a fault, on behalf of `by`."""
        faulty = self.endpoint.faulty
        faulty.inject(fault)
        self._watch.add(Occurrence(self._feed.reached_us, by, f"fault {fault.kind}", faulty.records[-1].number))

    def end_fault(self, number: int, by: str = "") -> None:
        """End a fault on behalf of `by`; one that is over already is left as it is."""
        faulty = self.endpoint.faulty
        if faulty.end(number):
            kind = next(record.kind for record in faulty.records if record.number == number)
            self._watch.add(Occurrence(self._feed.reached_us, by, f"end of fault {kind}", number))

    def happen(self, kind: EdgeKind | None, by: str = "") -> None:
        """Apply an edge to the input now, or reset the clock, on behalf of `by`."""
        self._feed.happen(kind)
        event = "reset" if kind is None else kind.name.lower()
        self._watch.add(Occurrence(self._feed.reached_us, by, f"trigger {event}"))

    def _free_until_us(self, now_us: int) -> int:
        """Return the stream time that an unpaced run may reach now: a host's silence lasts in the host's time too.

        It stands still while a host writes settings, so that no step ends between two writes.
        """
        if self._watch.pending is not None:
            return self._feed.reached_us
        if self.endpoint.faulty.withholds:  # the FIFO is not emptied: it overflows, as in real time
            return min(now_us, self._feed.reached_us + _WITHHELD_STEP_US)
        until_us = self._feed.readings.until_us(min(now_us, self._feed.horizon_us))
        if not isinstance(self._device, StartsSilent) or self._device.silent_until_us <= self._device.now_us:
            return until_us
        silent_until_us = self._device.silent_until_us
        if self._silence[0] != silent_until_us:
            self._silence = silent_until_us, self._feed.reached_us, self._clock.now_ns()
        _, begun_us, begun_ns = self._silence
        return min(until_us, begun_us + (self._clock.now_ns() - begun_ns) // 1000)

    @property
    def idle(self) -> bool:
        """True when no data wait, neither in the ring nor in the camera."""
        if self._lags or self.ring.waiting or self._feed.readings.waiting:
            return False
        return self._device.waiting_items == 0

    def report(self, *, final: bool = False, error: str | None = None) -> LinkReport:
        """Return the report of the link; the final report counts the data left in the ring as dropped."""
        counters = self._device.counters
        left = self.ring.waiting if final else 0
        faults = self.endpoint.faulty.records
        endpoint = self.endpoint.report()
        adjusted = self._device if isinstance(self._device, HostAdjusted) else None
        destroyed = sum(fault.events_lost for fault in faults)
        of_truth = "" if self._truth is None else self._truth.trouble
        troubles = (self._deliveries.trouble, of_truth, endpoint.trouble, *(fault.log_trouble for fault in faults))
        return LinkReport(
            state="closed" if final else self.endpoint.state,
            address=None if final else endpoint.address,
            attach_command="" if final else endpoint.attach_command,
            delivered=counters.delivered - destroyed,
            dropped=counters.lost_on_link + self.ring.refused + left + destroyed,
            camera=counters,
            latency=self._deliveries.latency.summary(),
            digest=self._deliveries.digest,
            final=final,
            error=error,
            use=endpoint.use,
            counts=endpoint.counts,
            edges=self._feed.edge_report(final=final),
            clock=self._clock_report(final=final),
            faults=faults,
            file_troubles=tuple(dict.fromkeys(filter(None, troubles))),
            sensor_factors={} if adjusted is None else adjusted.sensor_factors,
            without_effect={} if adjusted is None else adjusted.without_effect,
            readings=self._feed.readings.reports(final=final),
            recordings=tuple(file for file in (self._deliveries.recording, endpoint.recording) if file is not None),
        )

    def _clock_report(self, *, final: bool) -> ClockReport | None:
        if final:  # the host has disconnected, so the device's time is not valid
            return self._last_clock
        report = self._last_clock = self._feed.clock_report()
        origin_ns = self.ring.origin_ns
        if report is not None and self._truth is not None and origin_ns is not None:
            at_ns = self._clock.now_ns() if origin_ns == FREE_RUNNING else origin_ns + report.t_us * 1000
            self._truth.write(f"{at_ns},{report.t_us},{report.device_us:.3f}\n".encode("ascii"))
        return report

    async def close(self) -> None:
        """Close the endpoint, then the records; data left in the camera are flushed and counted."""
        self._clock_report(final=False)
        await self.endpoint.close()
        self._deliveries.close()
        if self._truth is not None:
            self._truth.close()
