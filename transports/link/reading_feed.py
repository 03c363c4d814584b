"""What goes from the rings of readings into a device, in the device's own time, and what its host asks back."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from firmware_protocol.device_clock import DeviceClock
from firmware_protocol.event_device import EventDevice
from firmware_protocol.readings import ReadingKind
from transports.link.reading_ring import ReadingRing

__all__ = ["ReadingFeed", "ReadingReport"]


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
