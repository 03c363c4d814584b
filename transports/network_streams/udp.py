"""Datagrams to one address as a link's endpoint, no faster than its rate.

UDP has no back-pressure: what a receiver does not read in time is gone, and nobody is told. An event counts as
delivered when the kernel has taken its datagram.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain

from firmware_protocol.network_streams.coder import Datagram, DatagramCoder
from firmware_protocol.plain_device import PlainDevice, Taken, own_time
from transports.link.deliveries import Deliveries
from transports.link.endpoint import Endpoint, EndpointFactory
from transports.network.datagrams import ByteBudget, DatagramOutlet
from transports.network_streams.parameters import UdpStream

__all__ = ["UdpEndpoint", "UdpFactory"]

_MOST_EVENTS = 1 << 14  # coded at once


@dataclass(frozen=True)
class UdpFactory(EndpointFactory[PlainDevice]):
    """Sends a stream as `link` says, in the datagrams of the coder that `coder` makes."""

    link: UdpStream
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
