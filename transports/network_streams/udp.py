"""Datagrams to one address as a link's endpoint, at a limited rate.

UDP has no back-pressure: data that a receiver does not read in time are lost without a report. An event counts as
delivered when the kernel has taken its datagram.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

from firmware_protocol.device.items import Items
from firmware_protocol.device.plain_device import PlainDevice, own_time
from firmware_protocol.network_streams.coders import Datagram, StreamFacts
from transports.link.deliveries import Deliveries
from transports.link.endpoint import BUSY_NS, HOSTED_NS, Endpoint, EndpointReport
from transports.link.kind import Wiring
from transports.network import ByteBudget, DatagramOutlet
from transports.network_streams.kind import DATAGRAM_CODERS, UdpLink

_MOST_EVENTS = 1 << 14  # encoded at once


class UdpEndpoint(Endpoint):
    """Endpoint of one stream to one address."""

    def __init__(self, link: UdpLink, wiring: Wiring, device: PlainDevice, deliveries: Deliveries) -> None:
        self._device = device
        self._clock = deliveries.clock
        facts = StreamFacts(wiring.camera.size, wiring.camera.model.upper(), form=link.format)
        self._coder = DATAGRAM_CODERS[link.format](facts)
        self._budget = ByteBudget(link.mbit_s, self._clock.now_ns())
        self._batch = _OpenItems(device, deliveries)
        self._datagrams: Iterator[Datagram] = iter(())
        self._next: Datagram | None = None
        self._outlet = DatagramOutlet(link.host, link.port)
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
        """Longest time until the next `pump`."""
        return BUSY_NS if self._next is not None or self._device.waiting else HOSTED_NS

    async def close(self) -> None:
        """Close the socket; events that have not left are lost."""
        self._batch.give_up()
        self._device.run(False)
        self._outlet.close()

    @property
    def state(self) -> str:
        """Number of datagrams, and their destination."""
        return f"{self._outlet.counts['datagrams']} datagrams to {self._outlet.address}"

    def report(self) -> EndpointReport:
        """Return the receiver's address, and counts of datagrams: sent, refused by the receiver, failed."""
        return EndpointReport(self._outlet.address, counts=+self._outlet.counts)

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


class _OpenItems:
    """Events that were taken together, with the numbers that have left and that were reported."""

    def __init__(self, device: PlainDevice, deliveries: Deliveries) -> None:
        self._device = device
        self._deliveries = deliveries
        self._taken: Items | None = None
        self._reported = self._reached = 0

    def begin(self, taken: Items) -> None:
        self._taken = taken
        self._reported = self._reached = 0

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
