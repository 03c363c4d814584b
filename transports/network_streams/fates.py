"""What becomes of the events of a batch that several clients are to get.

A batch is delivered when the first client's socket has taken all of it, and lost when no client is left that could.
What single clients miss is counted by them.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from firmware_protocol.plain_device import PlainDevice, Taken
from transports.link.deliveries import Deliveries

__all__ = ["Batch", "Fates"]

_MOST_OPEN = 1 << 22  # events whose fate, or that of events before them, is open


@dataclass(eq=False)
class Batch:
    """Events and their bytes; `holders` clients have it and have not sent it yet."""

    taken: Taken
    data: bytes | bytearray
    holders: int = 0
    delivered: bool = False

    @property
    def settled(self) -> bool:
        """Whether its fate is known."""
        return self.delivered or not self.holders


class Fates:
    """Follows batches, and tells the device and `deliveries`, the latter in the order in which they were taken."""

    def __init__(self, device: PlainDevice, deliveries: Deliveries) -> None:
        self._device = device
        self._deliveries = deliveries
        self._open: deque[Batch] = deque()
        self._open_events = 0

    def begin(self, batch: Batch) -> None:
        """Follow a batch whose holders are known."""
        self._open.append(batch)
        self._open_events += len(batch.taken.events)
        if batch.settled:  # nobody had room
            self._device.failed(len(batch.taken.events), len(batch.taken.edges))
            self._tell()

    def written(self, batch: Batch) -> None:
        """A client's socket has taken it."""
        batch.holders -= 1
        if not batch.delivered:
            batch.delivered = True
            self._device.arrived(len(batch.taken.events), len(batch.taken.edges))
            self._tell()

    def dropped(self, batch: Batch) -> None:
        """A client that had it has gone."""
        batch.holders -= 1
        if batch.settled and not batch.delivered:
            self._device.failed(len(batch.taken.events), len(batch.taken.edges))
            self._tell()

    @property
    def overdue(self) -> Batch | None:
        """The first batch, when so much has been taken after it that its holders must be given up."""
        return self._open[0] if self._open_events > _MOST_OPEN else None

    def _tell(self) -> None:
        while self._open and self._open[0].settled:
            batch = self._open.popleft()
            taken = batch.taken
            self._open_events -= len(taken.events)
            if batch.delivered:
                self._deliveries.add(taken.events, taken.epoch_us, taken.edges)
