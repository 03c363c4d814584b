"""Delivery statistics of one link: latency, digest, record and count of the events that left the camera.

The latency histogram has a fixed size, for runs and latencies of any length. Below 0.2 s a bin is 10 us wide; above
that each bin is 1 % wider than the one before, up to a year.

The digest is a checksum of a stream of events: equal digests on both ends mean that every event arrived unchanged.

Parts of a recording are made from the delivered data, in the time of the camera's clock.

The count of delivered events is in shared memory and is written after every tick. A killed process sends no last
report, so the ledger of a run takes the number of events that had left the camera from this count.
"""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
import numpy.typing as npt

from firmware_protocol.device.clock import DeviceClock
from firmware_protocol.device.items import Items, Reading, ReadingKind
from firmware_protocol.device.plain_device import own_time
from firmware_protocol.events import Edges, Events, copy_events, empty_edges
from firmware_protocol.frames import FrameAssembler, WholeFrame, brightness
from firmware_protocol.imu_samples import ImuSamples, no_samples, physical
from firmware_protocol.recordings.part import IMU, Facts, Frame, Part, RecordingSummary, counts_of
from transports.link.pacing import Clock
from transports.link.rings import FREE_RUNNING, EventRing, SharedMemory

_BIN_US = 10
_EVEN_BINS = 20_000
_EVEN_US = float(_BIN_US * _EVEN_BINS)
_RATIO = 1.01
_YEAR_US = 3.2e13  # the longest run
_MOST_PENDING = 1 << 13  # 64 kB an array: larger ones are new pages of memory each time, four times as slow
_BINS = _EVEN_BINS + math.ceil(math.log(_YEAR_US / _EVEN_US, _RATIO))


@dataclass(frozen=True)
class LatencySummary:
    """Latency from an event's own time to the sending of its bytes, us, or None; `p999` is the 99.9th percentile."""

    p50: float | None = None
    p99: float | None = None
    max: float | None = None
    p999: float | None = None


class LatencyHistogram:
    """Histogram of latencies in bins of 10 us up to 0.2 s, and of 1 % above; the largest is stored exactly.

    Latencies are counted some thousand at once: for a few events, the calls would cost more than the counting.
    """

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, np.int64)
        self._max_us: float | None = None
        self._now_us: list[float] = []
        self._pending: list[npt.NDArray[Any]] = []
        self._pending_count = 0

    def add(self, latency_us: npt.NDArray[np.floating[Any]]) -> None:
        """Count latencies, shape (n,), us, which stay unchanged; an event that leaves before its time counts as 0."""
        self.add_times(-latency_us, 0.0)

    def add_times(self, times_us: npt.NDArray[Any], now_us: float) -> None:
        """Count the latencies at `now_us` of events of `times_us`, shape (n,), us, which stay unchanged."""
        self._now_us.append(now_us)
        self._pending.append(times_us)
        self._pending_count += len(times_us)
        if self._pending_count >= _MOST_PENDING:
            self._count()

    def _count(self) -> None:
        """Count the latencies that were added since the last call."""
        if not self._pending_count:
            return
        latency_us = np.repeat(self._now_us, [len(times) for times in self._pending])
        latency_us -= np.concatenate(self._pending)
        self._now_us = []
        self._pending = []
        self._pending_count = 0
        self._max_us = max(self._max_us or 0.0, float(latency_us.max()))
        counts = np.bincount(_bins(latency_us))
        self._counts[: len(counts)] += counts

    def summary(self) -> LatencySummary:
        """Return median, 99th and 99.9th percentile (upper edge of the bin, never above the maximum) and maximum."""
        self._count()
        if self._max_us is None:
            return LatencySummary()
        cumulative = np.cumsum(self._counts)
        bins = np.searchsorted(cumulative, np.array([0.5, 0.99, 0.999]) * cumulative[-1]).tolist()
        p50, p99, p999 = (min(_upper_edge_us(index), self._max_us) for index in bins)
        return LatencySummary(p50, p99, self._max_us, p999)


def _bins(latency_us: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.int64]:
    """Return the bin of each latency."""
    bins: npt.NDArray[np.int64] = (np.clip(latency_us, 0, _EVEN_US - 1) / _BIN_US).astype(np.int64)
    long = latency_us >= _EVEN_US
    if long.any():
        above = np.log(latency_us[long] / _EVEN_US) / math.log(_RATIO)
        bins[long] = np.minimum(_EVEN_BINS + above.astype(np.int64), _BINS - 1)
    return bins


def _upper_edge_us(index: int) -> float:
    if index < _EVEN_BINS:
        return float((index + 1) * _BIN_US)
    return math.inf if index == _BINS - 1 else _EVEN_US * _RATIO ** (index + 1 - _EVEN_BINS)


def digest_of(events: Events, before: int = 0) -> int:
    """Return the CRC-32 of EVENT records (n,) that follow those with the digest `before`."""
    return zlib.crc32(np.ascontiguousarray(events).data, before) if len(events) else before


class DeliveredParts:
    """Converter from delivered data to parts of a recording; assembles frames from their lines.

    Parameters
    ----------
    imu_unit : type of the inertial unit, for its temperature.

    Attributes
    ----------
    frame_records : number of readings of each frame, in the order in which the frames were completed.
    """

    def __init__(self, imu_unit: int) -> None:
        self._imu_unit = imu_unit
        self._frames = FrameAssembler()
        self.frame_records: list[int] = []

    def part(self, events: Events, edges: Edges, readings: Sequence[Reading], epoch_us: int) -> Part:
        """Return copies of data that left together, less `epoch_us`, the clock's zero; negative if before the run."""
        samples = (reading.record for reading in readings if reading.kind is ReadingKind.IMU)
        imu = recorded_imu(np.concatenate([no_samples(), *samples]), self._imu_unit)
        events, edges = copy_events(events), edges.copy()
        for records in (events, edges, imu):
            if len(records):
                records["t"] -= np.uint64(epoch_us % (1 << 64))
        frames = self._frames.add(tuple(readings))
        self.frame_records += [frame.records for frame in frames]
        return Part(events, edges, imu, tuple(_frame(frame, epoch_us) for frame in frames))


def recorded_imu(samples: ImuSamples, unit: int) -> npt.NDArray[np.void]:
    """Return samples, (n,) IMU_SAMPLE of a unit (1 or 2), in the layout of recordings, (n,) IMU."""
    out = np.zeros(len(samples), IMU)
    if not len(samples):
        return out
    in_units = physical(samples, unit)
    out["t"], out["temperature"] = in_units["t"], in_units["temperature_c"]
    for k, axis in enumerate("xyz"):
        out[f"accelerometer_{axis}"] = in_units["acceleration_g"][:, k]
        out[f"gyroscope_{axis}"] = in_units["rate_deg_s"][:, k]
    return out


def _frame(frame: WholeFrame, epoch_us: int) -> Frame:
    """Return a frame for a recording, at the start of its exposure as in drivers, at least 0: the clock may restart."""
    begin_us, end_us = (max(0, t_us - epoch_us) for t_us in (frame.exposure_start_us, frame.exposure_end_us))
    return Frame(begin_us, begin_us, end_us, brightness(frame.reset, frame.signal), frame.origin)


class DeliveryRecorder(Protocol):
    """Recorder of what a link delivers."""

    @property
    def trouble(self) -> str:
        """Reason for an incomplete record, for people; empty if it is complete."""

    @property
    def summary(self) -> RecordingSummary | None:
        """Summary of the closed file; None if there is none."""

    def append(self, part: Part, *, restarted: bool = False, unix_us: int | None = None) -> None:
        """Add a part in device time; `unix_us`: Unix time of its zero, None in a run without pacing."""

    def reach(self, t_us: int) -> None:
        """Note that no event earlier than `t_us`, in device time, will come."""

    def close(self) -> None:
        """Finish the record."""


class RecorderFactory(Protocol):
    """Factory of a recorder inside the link's process; passed to that process by pickling."""

    def open(self, facts: Facts) -> DeliveryRecorder:
        """Return the recorder, with facts of the camera for its file; raises OSError where it cannot be opened."""

    def restarted(self, number: int) -> Self:
        """Return the factory for the `number`-th restart of the link, which must not overwrite the earlier file."""


class Deliveries:
    """Latency, digest and record of the events that an endpoint reports as sent.

    Parameters
    ----------
    device_clock : the camera's own clock, if its times are not stream time.
    imu_unit : type of the camera's inertial unit, for its temperature.

    Attributes
    ----------
    clock : clock of the link.
    """

    def __init__(
        self,
        ring: EventRing,
        clock: Clock,
        recorder: DeliveryRecorder | None = None,
        device_clock: DeviceClock | None = None,
        imu_unit: int = 2,
    ) -> None:
        self._ring = ring
        self.clock = clock
        self._recorder = recorder
        self._device_clock = device_clock
        self._epoch_us: int | None = None
        self._unix_us: int | None = None
        self.latency = LatencyHistogram()
        self.digest = 0
        self._parts = DeliveredParts(imu_unit)

    def add(
        self, events: Events, epoch_us: int = 0, edges: Edges | None = None, readings: Sequence[Reading] = ()
    ) -> None:
        """Add events (n,) EVENT, edges (m,) EDGE and readings that have just left, in the device's time.

        `epoch_us` is the time at which the device's own clock was zero; negative if that was before the run.
        """
        edges = empty_edges() if edges is None else edges
        if len(events):
            self._measure(events)
        if self._recorder is None:
            if len(events) or len(edges):
                self._follow(own_time(events, epoch_us), epoch_us)
            return
        part = self._parts.part(events, edges, readings, epoch_us)
        if counts_of(part):
            restarted = self._follow(part.events, epoch_us)
            if restarted:
                self._unix_us = self.unix_us(epoch_us)
            self._recorder.append(part, restarted=restarted, unix_us=self._unix_us)

    def add_items(self, items: Items) -> None:
        """Add the events and edges of `items`, as `add`."""
        self.add(items.events, items.epoch_us, items.edges)

    def reach(self, device_us: int, epoch_us: int) -> None:
        """Record that everything up to `device_us`, in the device's time, has left or was dropped."""
        if self._recorder is not None and epoch_us == self._epoch_us:
            self._recorder.reach(device_us - epoch_us)

    @property
    def paced(self) -> bool:
        """True if events leave at their own time; False if they leave as fast as possible."""
        return self._ring.origin_ns != FREE_RUNNING

    def device_ns(self, monotonic_ns: int) -> int | None:
        """Return the camera's clock at a time of CLOCK_MONOTONIC; None if unpaced. Receivers see it less `epoch_us`."""
        origin_ns = self._ring.origin_ns
        if origin_ns is None or origin_ns == FREE_RUNNING or monotonic_ns < origin_ns:
            return None
        stream_ns = monotonic_ns - origin_ns
        return stream_ns if self._device_clock is None else int(self._device_clock.shown_ns(stream_ns)[0])

    def unix_us(self, epoch_us: int) -> int | None:
        """Return the Unix time at which a device's clock with this epoch was zero; None when not paced."""
        origin_ns = self._ring.origin_ns
        if origin_ns is None or origin_ns == FREE_RUNNING:
            return None
        return (time.time_ns() - self.clock.now_ns() + origin_ns) // 1000 + epoch_us

    @property
    def trouble(self) -> str:
        """Reason for an incomplete record, for people; empty if it is complete or there is none."""
        return "" if self._recorder is None else self._recorder.trouble

    @property
    def recording(self) -> RecordingSummary | None:
        """Summary of the closed record; None if there is none."""
        return None if self._recorder is None else self._recorder.summary

    def close(self) -> None:
        """Close the record."""
        if self._recorder is not None:
            self._recorder.close()

    def _measure(self, events: Events) -> None:
        origin_ns = self._ring.origin_ns
        if origin_ns is None or origin_ns == FREE_RUNNING:
            return
        now_us = (self.clock.now_ns() - origin_ns) / 1000
        device_us = events["t"].view(np.int64)
        if self._device_clock is None:
            self.latency.add_times(device_us, now_us)
        else:
            self.latency.add_times(self._device_clock.stream_us(device_us, max(0, int(now_us))), now_us)

    def _follow(self, events: Events, epoch_us: int) -> bool:
        """Add events, (n,) EVENT in the time of the device's clock, to the digest; return True if it has restarted."""
        restarted = epoch_us != self._epoch_us
        self._epoch_us = epoch_us
        self.digest = digest_of(events, 0 if restarted else self.digest)
        return restarted


class DeliveryTally:
    """Number of events delivered: one writer, any number of readers. Can be passed to a process by the spawn method."""

    def __init__(self) -> None:
        # One aligned 8-byte store is atomic; a killed process could leave a lock taken for ever.
        self._memory = SharedMemory(8)

    @property
    def delivered(self) -> int:
        """Number of events that left the camera and were not lost on the link."""
        return memoryview(self._memory.octets).cast("q")[0]

    @delivered.setter
    def delivered(self, count: int) -> None:
        memoryview(self._memory.octets).cast("q")[0] = count
