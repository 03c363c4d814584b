"""A device watched from outside: how late its events leave, their digest, and their record."""

from __future__ import annotations

import numpy as np

from firmware_protocol.event_copies import copy_events
from firmware_protocol.usb.device import Identity, SetupPacket, Transfer, UsbDevice
from transports.digest import digest_of
from transports.latency import LatencyHistogram
from transports.pacing import Clock
from transports.record import Recorder
from transports.ring import FREE_RUNNING, EventRing

__all__ = ["Observed"]


class Observed(UsbDevice):
    """A device whose deliveries are timed, digested and recorded, without its knowing."""

    def __init__(self, device: UsbDevice, ring: EventRing, clock: Clock, recorder: Recorder | None) -> None:
        self._device = device
        self._ring = ring
        self._clock = clock
        self._recorder = recorder
        self._epoch_us: int | None = None
        self.latency = LatencyHistogram()
        self.digest = 0

    @property
    def identity(self) -> Identity:
        """The device's own."""
        return self._device.identity

    def attached(self) -> None:
        """Pass on."""
        self._device.attached()

    def detached(self) -> None:
        """Pass on."""
        self._device.detached()

    def control(self, setup: SetupPacket, data: bytes) -> bytes:
        """Pass on."""
        return self._device.control(setup, data)

    def read(self, endpoint: int, max_bytes: int) -> Transfer | None:
        """Pass on."""
        return self._device.read(endpoint, max_bytes)

    def sent(self, transfer: Transfer) -> None:
        """Measure and record what left, and pass on."""
        if len(transfer.events):
            self._measure(transfer)
            self._keep(transfer)
        self._device.sent(transfer)

    def lost(self, transfer: Transfer) -> None:
        """Pass on."""
        self._device.lost(transfer)

    def _measure(self, transfer: Transfer) -> None:
        origin_ns = self._ring.origin_ns
        if origin_ns is None or origin_ns == FREE_RUNNING:
            return
        now_us = (self._clock.now_ns() - origin_ns) / 1000
        self.latency.add(now_us - transfer.events["t"].astype(np.float64))

    def _keep(self, transfer: Transfer) -> None:
        events = copy_events(transfer.events)
        events["t"] -= np.uint64(transfer.epoch_us)
        restarted = transfer.epoch_us != self._epoch_us
        self._epoch_us = transfer.epoch_us
        self.digest = digest_of(events, 0 if restarted else self.digest)
        if self._recorder is not None:
            self._recorder.append(events, restarted=restarted)
