"""Datagrams to one address as a link's endpoint, at a limited rate, and the fates of batches for several clients.

UDP has no back-pressure: data that a receiver does not read in time are lost without a report. An event counts as
delivered when the kernel has taken its datagram.

`Fates` follows batches that several clients are to get. A batch is delivered when the first client's socket has taken
all of it, and lost when no client is left that could. Events that single clients miss are counted by the clients.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain

from firmware_protocol.device.items import Items
from firmware_protocol.device.plain_device import PlainDevice, own_time
from firmware_protocol.network_streams.coders import Datagram, DatagramCoder
from transports.link.deliveries import Deliveries
from transports.link.endpoint import BUSY_NS, HOSTED_NS, Endpoint, EndpointFactory
from transports.network.datagrams import ByteBudget, DatagramOutlet
from transports.network_streams.kind import UdpLink

__all__ = ["Batch", "Fates", "UdpEndpoint", "UdpFactory"]


_MOST_EVENTS = 1 << 14  # encoded at once


@dataclass(frozen=True)
class UdpFactory(EndpointFactory[PlainDevice]):
    """Factory of an endpoint for the stream of `link`; `coder` makes the coder of its datagrams."""

    link: UdpLink
    coder: Callable[[], DatagramCoder]

    def build(self, device: PlainDevice, deliveries: Deliveries) -> UdpEndpoint:
        """Return the endpoint; its socket is not open yet."""
        return UdpEndpoint(self, device, deliveries)


class UdpEndpoint(Endpoint):
    """Endpoint of one stream to one address."""

    def __init__(self, factory: UdpFactory, device: PlainDevice, deliveries: Deliveries) -> None:
        self._device = device
        self._clock = deliveries.clock
        self._coder = factory.coder()
        self._budget = ByteBudget(factory.link.mbit_s, self._clock.now_ns())
        self._batch = _Batch(device, deliveries)
        self._datagrams: Iterator[Datagram] = iter(())
        self._next: Datagram | None = None
        self._outlet = DatagramOutlet(factory.link.host, factory.link.port)
        self._epoch_us = 0
        device.takes_edges = self._coder.has_edges

    async def start(self) -> None:
        """Open the socket; raises OSError, with the remedy, when the address cannot be used."""
        self._outlet.open()

    def pump(self) -> None:
        """Send the waiting datagrams as far as the rate permits."""
        self._budget.renew(self._clock.now_ns())
        while self._budget.left > 0 and self._prepare() and self._send():
            pass
        self._batch.report()

    @property
    def longest_sleep_ns(self) -> int:
        """See `Endpoint.longest_sleep_ns`."""
        return BUSY_NS if self._next is not None or self._device.waiting else HOSTED_NS

    async def close(self) -> None:
        """Close the socket; events that have not left are lost."""
        self._batch.give_up()
        self._device.run(False)
        self._outlet.close()

    @property
    def state(self) -> str:
        """Number of datagrams, and their destination."""
        return f"{self._outlet.counts['datagrams']} datagrams to {self.address}"

    @property
    def address(self) -> str:
        """Host and port of the receiver."""
        return self._outlet.address

    @property
    def counts(self) -> Mapping[str, int]:
        """Numbers of datagrams sent, refused by the receiver's machine because no program listens, and not sendable."""
        return +self._outlet.counts

    def _prepare(self) -> bool:
        """Prepare a datagram; return False when there is nothing to send."""
        while self._next is None:
            self._next = next(self._datagrams, None)
            if self._next is not None:
                return True
            self._batch.finish()
            taken = self._device.take(_MOST_EVENTS)
            if taken is None:
                return False
            self._begin(taken)
        return True

    def _begin(self, taken: Items) -> None:
        self._batch.begin(taken)
        restart = self._coder.restart() if taken.epoch_us != self._epoch_us else iter(())
        self._epoch_us = taken.epoch_us
        events, edges = own_time(taken.events, taken.epoch_us), own_time(taken.edges, taken.epoch_us)
        self._datagrams = chain(restart, self._coder.encode(events, edges))

    def _send(self) -> bool:
        """Send the prepared datagram; return False when the kernel accepts none now."""
        assert self._next is not None
        try:
            left = self._outlet.send(self._next.data)
        except BlockingIOError:
            return False
        self._batch.reached(self._next.end, left=left)
        self._budget.left -= len(self._next.data)
        self._next = None
        return True


class _Batch:
    """Events that were taken together, with the numbers that have left and that were reported."""

    def __init__(self, device: PlainDevice, deliveries: Deliveries) -> None:
        self._device = device
        self._deliveries = deliveries
        self._taken: Items | None = None
        self._reported = self._reached = 0

    def begin(self, taken: Items) -> None:
        self._taken, self._reported, self._reached = taken, 0, 0

    def reached(self, end: int, *, left: bool) -> None:
        """Record that the datagrams with events up to `end` have left, or that the last of them could not be sent."""
        if not left:
            self.report()
            assert self._taken is not None
            self._device.lost(Items(self._taken.events[self._reported : end]))
            self._reported = end
        self._reached = end

    def report(self) -> None:
        """Report the events that have left since the last call."""
        if self._taken is not None and self._reached > self._reported:
            events = self._taken.events[self._reported : self._reached]
            self._device.sent(Items(events))
            self._deliveries.add(events, self._taken.epoch_us)
            self._reported = self._reached

    def finish(self) -> None:
        """Record that all its datagrams have left."""
        if self._taken is None:
            return
        self.report()
        if len(self._taken.edges):
            self._device.sent(Items(edges=self._taken.edges))
            self._deliveries.add(self._taken.events[:0], self._taken.epoch_us, self._taken.edges)
        self._taken = None

    def give_up(self) -> None:
        """Record that the rest is lost."""
        if self._taken is not None:
            self.report()
            self._device.lost(Items(self._taken.events[self._reported :], self._taken.edges))
            self._taken = None


_MOST_OPEN = 1 << 22  # events whose fate, or that of earlier events, is open


@dataclass(eq=False)
class Batch:
    """Events and their bytes; `holders` is the number of clients that have it and have not sent it yet."""

    taken: Items
    data: bytes | bytearray
    holders: int = 0
    delivered: bool = False

    @property
    def settled(self) -> bool:
        """True if its fate is known."""
        return self.delivered or not self.holders


class Fates:
    """Fates of batches, reported to the device and, in the order in which they were taken, to `deliveries`."""

    def __init__(self, device: PlainDevice, deliveries: Deliveries) -> None:
        self._device = device
        self._deliveries = deliveries
        self._open: deque[Batch] = deque()
        self._open_events = 0

    def begin(self, batch: Batch) -> None:
        """Follow a batch whose holders are known."""
        self._open.append(batch)
        self._open_events += len(batch.taken.events)
        if batch.settled:  # no client had room
            self._device.lost(batch.taken)
            self._report()

    def written(self, batch: Batch) -> None:
        """Record that a client's socket has taken it."""
        batch.holders -= 1
        if not batch.delivered:
            batch.delivered = True
            self._device.sent(batch.taken)
            self._report()

    def dropped(self, batch: Batch) -> None:
        """Record that a client that had it was lost."""
        batch.holders -= 1
        if batch.settled and not batch.delivered:
            self._device.lost(batch.taken)
            self._report()

    @property
    def overdue(self) -> Batch | None:
        """First batch, when so much has been taken after it that its holders must be closed."""
        return self._open[0] if self._open_events > _MOST_OPEN else None

    def _report(self) -> None:
        while self._open and self._open[0].settled:
            batch = self._open.popleft()
            taken = batch.taken
            self._open_events -= len(taken.events)
            if batch.delivered:
                self._deliveries.add(taken.events, taken.epoch_us, taken.edges)
