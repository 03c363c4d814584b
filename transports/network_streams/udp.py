"""Datagrams to one address as a link's endpoint, no faster than its rate.

UDP has no back-pressure: what a receiver does not read in time is gone, and nobody is told. An event counts as
delivered when the kernel has taken its datagram.

What becomes of the events of a batch that several clients are to get.

A batch is delivered when the first client's socket has taken all of it, and lost when no client is left that could.
What single clients miss is counted by them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain

from firmware_protocol.device.plain_device import PlainDevice, Taken, own_time
from firmware_protocol.network_streams.coders import Datagram, DatagramCoder
from transports.link.deliveries import Deliveries
from transports.link.endpoint import Endpoint, EndpointFactory
from transports.network.datagrams import ByteBudget, DatagramOutlet
from transports.network_streams.kind import UdpLink

__all__ = ["Batch", "Fates", "UdpEndpoint", "UdpFactory"]


_MOST_EVENTS = 1 << 14  # coded at once


@dataclass(frozen=True)
class UdpFactory(EndpointFactory[PlainDevice]):
    """Sends a stream as `link` says, in the datagrams of the coder that `coder` makes."""

    link: UdpLink
    coder: Callable[[], DatagramCoder]

    def build(self, device: PlainDevice, deliveries: Deliveries) -> UdpEndpoint:
        """Return the endpoint, its socket not yet open."""
        return UdpEndpoint(self, device, deliveries)


class UdpEndpoint(Endpoint):
    """One stream to one address."""

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
        """Open the socket; raises OSError, with what to do, when the address cannot be used."""
        self._outlet.open()

    def pump(self) -> None:
        """Send what waits, as far as the rate allows."""
        self._budget.renew(self._clock.now_ns())
        while self._budget.left > 0 and self._prepare() and self._send():
            pass
        self._batch.tell()

    async def close(self) -> None:
        """Close the socket; what has not left is lost."""
        self._batch.give_up()
        self._device.run(False)
        self._outlet.close()

    @property
    def state(self) -> str:
        """Where it sends."""
        return f"{self._outlet.counts['datagrams']} datagrams to {self.address}"

    @property
    def address(self) -> str:
        """Host and port of the receiver."""
        return self._outlet.address

    @property
    def counts(self) -> Mapping[str, int]:
        """Datagrams; those that the receiver's machine refused, because nobody listens, and those that could not go."""
        return +self._outlet.counts

    def _prepare(self) -> bool:
        """Have a datagram ready; False when there is nothing to send."""
        while self._next is None:
            self._next = next(self._datagrams, None)
            if self._next is not None:
                return True
            self._batch.finish()
            taken = self._device.carry(_MOST_EVENTS)
            if taken is None:
                return False
            self._begin(taken)
        return True

    def _begin(self, taken: Taken) -> None:
        self._batch.begin(taken)
        restart = self._coder.restart() if taken.epoch_us != self._epoch_us else iter(())
        self._epoch_us = taken.epoch_us
        events, edges = own_time(taken.events, taken.epoch_us), own_time(taken.edges, taken.epoch_us)
        self._datagrams = chain(restart, self._coder.encode(events, edges))

    def _send(self) -> bool:
        """Send the datagram that is ready; False when the kernel takes none now."""
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
    """Events that were taken together: how many have left, and whether the device and `deliveries` know."""

    def __init__(self, device: PlainDevice, deliveries: Deliveries) -> None:
        self._device = device
        self._deliveries = deliveries
        self._taken: Taken | None = None
        self._told = self._reached = 0

    def begin(self, taken: Taken) -> None:
        self._taken, self._told, self._reached = taken, 0, 0

    def reached(self, end: int, *, left: bool) -> None:
        """The datagrams with events up to `end` have left, or the last of them could not."""
        if not left:
            self.tell()
            self._device.failed(end - self._told)
            self._told = end
        self._reached = end

    def tell(self) -> None:
        """Tell of the events that have left since the last call."""
        if self._taken is not None and self._reached > self._told:
            events = self._taken.events[self._told : self._reached]
            self._device.arrived(len(events))
            self._deliveries.add(events, self._taken.epoch_us)
            self._told = self._reached

    def finish(self) -> None:
        """All its datagrams have left."""
        if self._taken is None:
            return
        self.tell()
        if len(self._taken.edges):
            self._device.arrived(0, len(self._taken.edges))
            self._deliveries.add(self._taken.events[:0], self._taken.epoch_us, self._taken.edges)
        self._taken = None

    def give_up(self) -> None:
        """What has not left is lost."""
        if self._taken is not None:
            self.tell()
            self._device.failed(len(self._taken.events) - self._told, len(self._taken.edges))
            self._taken = None


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
