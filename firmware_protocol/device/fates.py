"""Fates of the items of a device: the one record in which every device and link counts.

    item      events, edges of the external input, readings (parts of frames, inertial samples) by kind
    fate      not running, not selected, dropped for one of several reasons, flushed, lost on the link, delivered,
              queued

Every item that was offered, or that the camera made itself, has exactly one fate at any time; `balanced` compares the
sums. A device counts in one `Fates` while it works, and returns a copy in which the items that still wait in its queues
are `queued`: their number is measured, so an item that a queue loses shows as an imbalance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal, Self

from firmware_protocol.device.items import Items, Numbers, ReadingKind

Fate = Literal["dropped_fifo", "flushed", "delivered", "lost_on_link"]
"""A fate that ends the way of items together, whatever their kind."""


@dataclass
class Counts:
    """Items of one kind by fate; `offered` and `added` together are the sum of the others.

    Attributes
    ----------
    added : Made by the camera beyond one for each item offered: a rising edge may be reported again as the pulse that
        it begins, and a generator makes its own edges.
    not_running : Arrived while no host had the camera, or this kind, running; or in the middle of a frame whose start
        the host did not get.
    ignored : edges that were not detected: the camera was not running, or its registers exclude this kind of edge.
    not_selected : excluded on purpose: outside the region of interest, or a pixel that sub-sampling skips.
    dropped_background, dropped_refractory
        Dropped by the camera's own filters of background activity and of the refractory period.
    dropped_rate : beyond the camera's rate limit.
    dropped_late : waited longer than the camera's age limit.
    dropped_fifo : found the camera's buffer full, in items or in bytes.
    flushed : were in the buffer when it was emptied, at a stop or when the host went away.
    lost_on_link : left the camera and were lost on the link.
    queued : still wait, or have left and their fate is open.
    """

    offered: int = 0
    added: int = 0
    not_running: int = 0
    ignored: int = 0
    not_selected: int = 0
    dropped_background: int = 0
    dropped_refractory: int = 0
    dropped_rate: int = 0
    dropped_late: int = 0
    dropped_fifo: int = 0
    flushed: int = 0
    lost_on_link: int = 0
    delivered: int = 0
    queued: int = 0

    @property
    def dropped_for_room(self) -> int:
        """Items that were to be sent and were dropped before; links report those of events as `dropped`."""
        return self.dropped_fifo + self.flushed + self.dropped_rate + self.dropped_late

    @property
    def dropped_in_device(self) -> int:
        """Items that the camera took and did not pass to the link."""
        filtered = self.not_selected + self.dropped_background + self.dropped_refractory
        return self.not_running + self.ignored + filtered + self.dropped_for_room

    @property
    def accounted(self) -> int:
        """Items with a fate; without an error as many as were offered and added."""
        return self.dropped_in_device + self.delivered + self.lost_on_link + self.queued

    @property
    def balanced(self) -> bool:
        """True when every item has exactly one fate."""
        return self.accounted == self.offered + self.added

    def settle(self, count: int, fate: Fate) -> None:
        """Give `count` queued items their last fate."""
        self.queued -= count
        setattr(self, fate, getattr(self, fate) + count)

    def copy(self) -> Self:
        """Return a copy that does not change any more."""
        return type(self)(**vars(self))


@dataclass
class Fates(Counts):
    """Fates of all items since a device was made: of its events, and of the items of other kinds.

    Attributes
    ----------
    edges : those of the edges of the external input.
    readings : those of parts of frames and of samples, by `ReadingKind`; empty for a camera that does not use them.
    """

    edges: Counts = field(default_factory=Counts)
    readings: dict[str, Counts] = field(default_factory=dict)

    @property
    def all_queued(self) -> int:
        """Items of all kinds that are queued."""
        return self.queued + self.edges.queued + sum(counts.queued for counts in self.readings.values())

    def of(self, kind: ReadingKind) -> Counts:
        """Return the counts of a kind of readings, which begin with the first call."""
        return self.readings.setdefault(str(kind), Counts())

    def take(self, items: Items) -> None:
        """Count items that leave their encoder; they count as queued until `leave`."""
        for counts, number in self._by_kind(items.numbers):
            counts.queued += number

    def leave(self, items: Items, fate: Fate) -> None:
        """Give items that were taken their last fate."""
        for counts, number in self._by_kind(items.numbers):
            counts.settle(number, fate)

    def drop(self, numbers: Numbers, fate: Fate = "flushed") -> None:
        """Give items that waited in an encoder, and are not taken any more, their last fate."""
        for counts, number in self._by_kind(numbers):
            counts.queued += number
            counts.settle(number, fate)

    def retract(self, numbers: Numbers) -> None:
        """Change the fate of delivered items to lost on the link."""
        for counts, number in self._by_kind(numbers):
            counts.delivered -= number
            counts.lost_on_link += number

    def waiting(self, numbers: Numbers) -> Fates:
        """Return a copy in which the items that wait in the device's queues are queued as well."""
        now = self.copy()
        now.edges, now.readings = self.edges.copy(), {kind: counts.copy() for kind, counts in self.readings.items()}
        for counts, number in now._by_kind(numbers):
            counts.queued += number
        return now

    def _by_kind(self, numbers: Numbers) -> Iterator[tuple[Counts, int]]:
        """Yield the counts of each kind of items, and its number."""
        yield self, numbers.events
        yield self.edges, numbers.edges
        for kind, number in numbers.readings.items():
            yield self.of(kind), number
