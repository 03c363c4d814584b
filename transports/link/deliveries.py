"""What a link delivered, seen from outside the camera: how late events left, their digest, and their record."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from firmware_protocol.device_clock import DeviceClock
from firmware_protocol.edges import Edges, empty_edges
from firmware_protocol.event_copies import copy_events
from firmware_protocol.events import Events
from firmware_protocol.frame_assembly import FrameAssembler, WholeFrame
from firmware_protocol.imu_samples import ImuSamples, no_samples, physical
from firmware_protocol.readings import Reading, ReadingKind
from transports.link.digest import digest_of
from transports.link.latency import LatencyHistogram
from transports.link.pacing import Clock
from transports.link.ring import FREE_RUNNING, EventRing
from transports.recording.opening import AnyRecorder
from transports.recording.part import IMU, Frame, Part

__all__ = ["Deliveries", "recorded_imu"]


class Deliveries:
    """Times, digests and records the events that an endpoint says have left.

    Parameters
    ----------
    device_clock
        The camera's own, where its times are not stream time.
    imu_unit
        Which inertial unit the camera has, for its temperature.

    Attributes
    ----------
    clock
        What the link goes by.
    """

    def __init__(
        self,
        ring: EventRing,
        clock: Clock,
        recorder: AnyRecorder | None = None,
        device_clock: DeviceClock | None = None,
        imu_unit: int = 2,
    ) -> None:
        self._ring = ring
        self.clock = clock
        self._recorder = recorder
        self._device_clock = device_clock
        self._imu_unit = imu_unit
        self._epoch_us: int | None = None
        self._unix_us: int | None = None
        self.latency = LatencyHistogram()
        self.digest = 0
        self._frames = FrameAssembler()

    def add(
        self, events: Events, epoch_us: int = 0, edges: Edges | None = None, readings: Sequence[Reading] = ()
    ) -> None:
        """Take note of events (n,) EVENT, edges (m,) EDGE and readings that have left just now, in the device's time.

        `epoch_us` is the time at which the device's own clock is zero; negative where that was before the run.
        """
        edges = empty_edges() if edges is None else edges
        if len(events):
            self._measure(events)
        part = self._with_readings(events, edges, readings, epoch_us) if readings else Part(events, edges)
        if len(events) or len(edges) or len(part.imu) or part.frames:
            self._keep(part, epoch_us)

    def _with_readings(self, events: Events, edges: Edges, readings: Sequence[Reading], epoch_us: int) -> Part:
        frames = self._frames.add(tuple(readings)) if self._recorder is not None else []
        told = tuple(_frame(frame, epoch_us) for frame in frames)
        return Part(events, edges, recorded_imu(_imu_of(readings), self._imu_unit), told)

    @property
    def paced(self) -> bool:
        """Whether events leave at their own time; else as fast as possible."""
        return self._ring.origin_ns != FREE_RUNNING

    def device_ns(self, monotonic_ns: int) -> int | None:
        """Return what the camera's clock shows at a time of CLOCK_MONOTONIC, less no epoch; None outside a paced run.

        What a receiver sees of it is less by the device's `epoch_us`.
        """
        origin_ns = self._ring.origin_ns
        if origin_ns is None or origin_ns == FREE_RUNNING or monotonic_ns < origin_ns:
            return None
        stream_ns = monotonic_ns - origin_ns
        return stream_ns if self._device_clock is None else int(self._device_clock.shown_ns(stream_ns)[0])

    def unix_us(self, epoch_us: int) -> int | None:
        """Return the Unix time at which a device's clock was zero that had its epoch then; None when not paced."""
        origin_ns = self._ring.origin_ns
        if origin_ns is None or origin_ns == FREE_RUNNING:
            return None
        return (time.time_ns() - self.clock.now_ns() + origin_ns) // 1000 + epoch_us

    @property
    def trouble(self) -> str:
        """Why the record is not whole, for people; empty where it is, or where there is none."""
        return "" if self._recorder is None else self._recorder.trouble

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
            self.latency.add(now_us - device_us)
        else:
            self.latency.add(now_us - self._device_clock.stream_us(device_us, max(0, int(now_us))))

    def _keep(self, part: Part, epoch_us: int) -> None:
        events, edges, imu = copy_events(part.events), part.edges.copy(), part.imu
        for records in (events, edges, imu):
            if len(records):
                records["t"] -= np.uint64(epoch_us % (1 << 64))
        restarted = epoch_us != self._epoch_us
        self._epoch_us = epoch_us
        self.digest = digest_of(events, 0 if restarted else self.digest)
        if self._recorder is not None:
            unix_us = self.unix_us(epoch_us) if restarted else self._unix_us
            self._unix_us = unix_us
            part = Part(events, edges, imu, part.frames)
            self._recorder.append(part, restarted=restarted, unix_us=unix_us)


def _imu_of(readings: Sequence[Reading]) -> ImuSamples:
    return np.concatenate([no_samples(), *(one.record for one in readings if one.kind is ReadingKind.IMU)])


def recorded_imu(samples: ImuSamples, unit: int) -> npt.NDArray[np.void]:
    """Return samples, (n,) IMU_SAMPLE of a unit (1 or 2), as recordings have them, (n,) IMU."""
    told, out = physical(samples, unit), np.zeros(len(samples), IMU)
    out["t"], out["temperature"] = told["t"], told["temperature_c"]
    for k, axis in enumerate("xyz"):
        out[f"accelerometer_{axis}"], out[f"gyroscope_{axis}"] = told["acceleration_g"][:, k], told["rate_deg_s"][:, k]
    return out


def _frame(frame: WholeFrame, epoch_us: int) -> Frame:
    """Return a frame for a recording: dated by the start of its exposure, as drivers do."""
    begin_us, end_us = frame.exposure_start_us - epoch_us, frame.exposure_end_us - epoch_us
    return Frame(begin_us, begin_us, end_us, frame.pixels, (frame.first_column, frame.first_row))
