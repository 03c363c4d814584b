"""A TCP server as a link's endpoint: every client gets the stream from the moment it connects.

    device.carry -> coder.encode -> Batch -> each client that has room -> its socket
            edges -> a coder of triggers -> the clients of a second port, where the rig has one

In a paced run a batch is taken when any client has room; those that have none miss it. In a run that is not paced it is
taken when all have room, but for those that have stopped reading, so that a run that nobody hurries loses nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec

from firmware_protocol.edges import empty_edges
from firmware_protocol.events import empty_events
from firmware_protocol.network_streams.coder import ConnectionCoder
from firmware_protocol.plain_device import PlainDevice, Taken, own_time
from transports.link.deliveries import Deliveries
from transports.link.endpoint import Endpoint, EndpointFactory
from transports.needs import install_command
from transports.network_streams.audience import Audience
from transports.network_streams.fates import Fates
from transports.network_streams.parameters import TcpStream

__all__ = ["TcpEndpoint", "TcpFactory"]

_MOST_EVENTS = 1 << 14  # of a batch


@dataclass(frozen=True)
class TcpFactory(EndpointFactory[PlainDevice]):
    """Serves a stream as `link` says, in the bytes of the coder that `coder` makes; `triggers` makes that of edges."""

    link: TcpStream
    coder: Callable[[], ConnectionCoder]
    triggers: Callable[[], ConnectionCoder] | None = None

    def build(self, device: PlainDevice, deliveries: Deliveries) -> TcpEndpoint:
        """Return the server, not yet listening."""
        return TcpEndpoint(self, device, deliveries)


class TcpEndpoint(Endpoint):
    """One stream on one port, and the camera's triggers on another where the rig says so."""

    def __init__(self, factory: TcpFactory, device: PlainDevice, deliveries: Deliveries) -> None:
        self._link, self._device, self._deliveries = factory.link, device, deliveries
        self._coder = factory.coder()
        self._triggers = None if factory.triggers is None else factory.triggers()
        self._fates = Fates(device, deliveries)
        clock = deliveries.clock
        self._clients = Audience(factory.link, self._coder, self._fates, clock, device.run)
        self._trigger_clients: Audience | None = None
        if self._triggers is not None:
            self._trigger_clients = Audience(factory.link, self._triggers, self._fates, clock, self._take_edges)
        self._epoch_us = 0
        device.takes_edges = self._coder.has_edges

    async def start(self) -> None:
        """Listen; raises OSError, with what to do, when a port or a compression cannot be had."""
        if self._link.compression == "lz4" and find_spec("lz4") is None:
            raise OSError(f"compression needs lz4: {install_command('files')}")
        self._device.run(False)
        self._clients.open(self._link.port)
        if self._trigger_clients is not None:
            self._trigger_clients.open(self._link.trigger_port or 0)

    def pump(self) -> None:
        """Hand what the camera has to the clients."""
        overdue = self._fates.overdue
        for clients in self._audiences:
            if overdue is not None:
                clients.give_up(overdue)
        while self._has_room and (taken := self._device.carry(_MOST_EVENTS)) is not None:
            self._send(taken)
        if len(self._clients) and not self._device.waiting:
            nothing = Taken(empty_events(), empty_edges(), self._epoch_us)
            self._clients.spread(nothing, self._coder.advance(self._device.now_us - self._epoch_us))

    async def close(self) -> None:
        """Let the clients take what is on its way to them, and close."""
        for clients in self._audiences:
            await clients.close()
        self._device.run(False)

    @property
    def state(self) -> str:
        """How many clients there are, or where they are waited for."""
        count = len(self._clients)
        if not count:
            return f"waiting for a client on {self.address}"
        return f"{count} client{'s' if count > 1 else ''} on {self.address}"

    @property
    def address(self) -> str | None:
        """Host and port that it listens on."""
        return self._clients.address

    @property
    def counts(self) -> Mapping[str, int]:
        """Clients so far, and what single ones missed."""
        triggers = {} if self._trigger_clients is None else self._trigger_clients.counts
        return Counter(self._clients.counts) + Counter({f"triggers: {name}": n for name, n in triggers.items()})

    @property
    def _audiences(self) -> list[Audience]:
        return [self._clients, *([] if self._trigger_clients is None else [self._trigger_clients])]

    @property
    def _has_room(self) -> bool:
        return self._clients.has_room(paced=self._deliveries.paced)

    def _take_edges(self, heard: bool) -> None:
        """Let the camera take edges while somebody is there for them."""
        self._device.takes_edges = self._coder.has_edges or heard

    def _send(self, taken: Taken) -> None:
        restarts = taken.epoch_us != self._epoch_us
        self._epoch_us = taken.epoch_us
        if self._triggers is not None and self._trigger_clients is not None:
            taken = self._send_triggers(taken, self._triggers, self._trigger_clients, restarts=restarts)
        restart = self._coder.restart() if restarts else b""
        data = self._coder.encode(own_time(taken.events, taken.epoch_us), own_time(taken.edges, taken.epoch_us))
        self._clients.spread(taken, restart + data if restart else data)

    def _send_triggers(self, taken: Taken, coder: ConnectionCoder, clients: Audience, *, restarts: bool) -> Taken:
        """Send the edges to their own clients; return what is left."""
        restart = coder.restart() if restarts and len(clients) else b""
        edges = Taken(empty_events(), taken.edges, taken.epoch_us)
        clients.spread(edges, restart + coder.encode(edges.events, own_time(edges.edges, edges.epoch_us)))
        return Taken(taken.events, empty_edges(), taken.epoch_us)
