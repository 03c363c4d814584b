"""What a link delivered, seen from outside the camera: how late events left, their digest, and their record."""

from __future__ import annotations

import numpy as np

from firmware_protocol.event_copies import copy_events
from firmware_protocol.events import Events
from transports.digest import digest_of
from transports.latency import LatencyHistogram
from transports.pacing import Clock
from transports.record import Recorder
from transports.ring import FREE_RUNNING, EventRing

__all__ = ["Deliveries"]


class Deliveries:
    """Times, digests and records the events that an endpoint says have left."""

    def __init__(self, ring: EventRing, clock: Clock, recorder: Recorder | None = None) -> None:
        self._ring = ring
        self._clock = clock
        self._recorder = recorder
        self._epoch_us: int | None = None
        self.latency = LatencyHistogram()
        self.digest = 0

    def add(self, events: Events, epoch_us: int = 0) -> None:
        """Take note of events (n,) EVENT, in stream time, that have left just now.

        `epoch_us` is the stream time at which the device's own clock was last zero.
        """
        if len(events):
            self._measure(events)
            self._keep(events, epoch_us)

    def close(self) -> None:
        """Close the record."""
        if self._recorder is not None:
            self._recorder.close()

    def _measure(self, events: Events) -> None:
        origin_ns = self._ring.origin_ns
        if origin_ns is None or origin_ns == FREE_RUNNING:
            return
        now_us = (self._clock.now_ns() - origin_ns) / 1000
        self.latency.add(now_us - events["t"].astype(np.float64))

    def _keep(self, events: Events, epoch_us: int) -> None:
        events = copy_events(events)
        events["t"] -= np.uint64(epoch_us)
        restarted = epoch_us != self._epoch_us
        self._epoch_us = epoch_us
        self.digest = digest_of(events, 0 if restarted else self.digest)
        if self._recorder is not None:
            self._recorder.append(events, restarted=restarted)
