"""What a link delivered, seen from outside the camera: how late events left, their digest, and their record."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from firmware_protocol.device_clock import DeviceClock
from firmware_protocol.edges import Edges, empty_edges
from firmware_protocol.events import Events
from firmware_protocol.readings import Reading
from transports.link.delivered_parts import Delivered, DeliveredParts
from transports.link.digest import digest_of
from transports.link.latency import LatencyHistogram
from transports.link.pacing import Clock
from transports.link.ring import FREE_RUNNING, EventRing
from transports.recording.opening import AnyRecorder
from transports.recording.part import Part, counts_of
from transports.recording.summary import RecordingSummary

__all__ = ["Deliveries"]


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
        self._epoch_us: int | None = None
        self._unix_us: int | None = None
        self.latency = LatencyHistogram()
        self.digest = 0
        self._parts = DeliveredParts(imu_unit)

    def add(
        self, events: Events, epoch_us: int = 0, edges: Edges | None = None, readings: Sequence[Reading] = ()
    ) -> None:
        """Take note of events (n,) EVENT, edges (m,) EDGE and readings that have left just now, in the device's time.

        `epoch_us` is the time at which the device's own clock is zero; negative where that was before the run.
        """
        edges = empty_edges() if edges is None else edges
        if len(events):
            self._measure(events)
        readings = () if self._recorder is None else readings
        part = self._parts.part(Delivered(events, edges, readings), epoch_us)
        if counts_of(part):
            self._keep(part, epoch_us)

    def reach(self, device_us: int, epoch_us: int) -> None:
        """Take note that all up to `device_us`, in the device's time, has left or was dropped."""
        if self._recorder is not None and epoch_us == self._epoch_us:
            self._recorder.reach(device_us - epoch_us)

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

    @property
    def recording(self) -> RecordingSummary | None:
        """What the record holds, once it is closed; None where there is none."""
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
            self.latency.add(now_us - device_us)
        else:
            self.latency.add(now_us - self._device_clock.stream_us(device_us, max(0, int(now_us))))

    def _keep(self, part: Part, epoch_us: int) -> None:
        restarted = epoch_us != self._epoch_us
        self._epoch_us = epoch_us
        self.digest = digest_of(part.events, 0 if restarted else self.digest)
        if self._recorder is not None:
            unix_us = self.unix_us(epoch_us) if restarted else self._unix_us
            self._unix_us = unix_us
            self._recorder.append(part, restarted=restarted, unix_us=unix_us)
