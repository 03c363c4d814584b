"""TCP server as a link's endpoint: every client gets the stream from the moment it connects.

    device.take -> coder.encode -> ClientBatch -> each client that has room -> its socket
            edges -> a coder of triggers -> the clients of a second port, where the rig has one

In a paced run a batch is taken when any client has room; clients without room miss it. In a run without pacing it is
taken when all clients have room, except those that have stopped reading, so that such a run loses nothing.

`Client` is one client: its waiting data, within a limit, and its missed events. `ClientGroup` has all clients of one
port, which get the same bytes from the moment they connect.
"""

from __future__ import annotations

import asyncio
import socket
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec

from firmware_protocol.device.items import Items
from firmware_protocol.device.plain_device import PlainDevice, own_time
from firmware_protocol.events import empty_edges, empty_events
from firmware_protocol.network_streams.coders import ConnectionCoder, DvTriggerCoder, StreamFacts
from transports.connections import Admission, Listener, Seat
from transports.link.deliveries import Deliveries
from transports.link.endpoint import BUSY_NS, REST_NS, Endpoint, EndpointReport
from transports.link.kind import Wiring
from transports.link.pacing import Clock
from transports.needs import install_command
from transports.network import AllowList
from transports.network_streams.kind import CONNECTION_CODERS, TcpLink

_MOST_OPEN = 1 << 22  # events whose fate, or that of earlier events, is open
_MOST_RECEIVED = 1 << 16  # bytes that a client may send: these protocols have no requests
_STALLED_NS = 2_000_000_000


@dataclass(eq=False)
class ClientBatch:
    """Events and their bytes; `holders` is the number of clients that have it and have not sent it yet."""

    taken: Items
    data: bytes | bytearray
    holders: int = 0
    delivered: bool = False

    @property
    def settled(self) -> bool:
        """True if its fate is known."""
        return self.delivered or not self.holders


class ClientBatches:
    """Batches for several clients whose fate is open.

    Fates are reported to the device and, in the order in which the batches were taken, to `deliveries`. A batch is
    delivered when the first client's socket has taken all of it, and lost when no client is left that could. Events
    that single clients miss are counted by the clients.
    """

    def __init__(self, device: PlainDevice, deliveries: Deliveries) -> None:
        self._device = device
        self._deliveries = deliveries
        self._open: deque[ClientBatch] = deque()
        self._open_events = 0

    def begin(self, batch: ClientBatch) -> None:
        """Follow a batch whose holders are known."""
        self._open.append(batch)
        self._open_events += len(batch.taken.events)
        if batch.settled:  # no client had room
            self._device.lost(batch.taken)
            self._report()

    def written(self, batch: ClientBatch) -> None:
        """Record that a client's socket has taken it."""
        batch.holders -= 1
        if not batch.delivered:
            batch.delivered = True
            self._device.sent(batch.taken)
            self._report()

    def dropped(self, batch: ClientBatch) -> None:
        """Record that a client that had it was lost."""
        batch.holders -= 1
        if batch.settled and not batch.delivered:
            self._device.lost(batch.taken)
            self._report()

    @property
    def overdue(self) -> ClientBatch | None:
        """First batch, when so much has been taken after it that its holders must be closed."""
        return self._open[0] if self._open_events > _MOST_OPEN else None

    def _report(self) -> None:
        while self._open and self._open[0].settled:
            batch = self._open.popleft()
            taken = batch.taken
            self._open_events -= len(taken.events)
            if batch.delivered:
                self._deliveries.add_items(taken)


class Client(asyncio.Protocol):
    """Connection to a client that only receives.

    Attributes
    ----------
    seat : its place in the server's admission.
    missed : number of events for which it had no room.
    sent_data : True if it was closed because it sent too much.
    """

    def __init__(self, group: ClientGroup, seat: Seat) -> None:
        self._group = group
        self.seat = seat
        self._transport: asyncio.Transport | None = None
        self._queue: deque[ClientBatch] = deque()
        self._sending: ClientBatch | None = None
        self._paused = False
        self._waiting_bytes = self._received = 0
        self._progress_ns = group.clock.now_ns()
        self.missed = 0
        self.sent_data = False

    @property
    def has_room(self) -> bool:
        """True if it can be given a batch now."""
        return self._waiting_bytes < self._group.most_bytes

    @property
    def stalled(self) -> bool:
        """True if data wait for it, and it has read nothing for two seconds."""
        return self._waiting_bytes > 0 and self._group.clock.now_ns() - self._progress_ns > _STALLED_NS

    def holds(self, batch: ClientBatch) -> bool:
        """Return True if a batch is the first that waits for it."""
        return batch is self._sending or (bool(self._queue) and batch is self._queue[0])

    def offer(self, batch: ClientBatch) -> None:
        """Queue a batch for it, as one of the batch's holders; `send_on` sends it."""
        if not self._waiting_bytes:
            self._progress_ns = self._group.clock.now_ns()
        self._queue.append(batch)
        self._waiting_bytes += len(batch.data)

    def send_on(self) -> None:
        """Send as much as its socket accepts."""
        while self._queue and not self._paused and self._transport is not None and not self._transport.is_closing():
            self._sending = self._queue.popleft()
            self._transport.write(self._sending.data)
            if not self._paused and not self._transport.is_closing():
                self._written()

    def hang_up(self) -> None:
        """Close after the data in transit were sent; queued data are not sent."""
        if self._transport is not None:
            self._transport.close()

    def abort(self) -> None:
        """Close at once."""
        if self._transport is not None:
            self._transport.abort()

    # Callbacks of asyncio.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Greet."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        transport.set_write_buffer_limits(high=0)  # so that "not paused" means that the socket has taken everything
        _keep_alive(transport.get_extra_info("socket"))
        transport.write(self._group.greeting)
        self._group.joined(self)

    def data_received(self, data: bytes) -> None:
        """Ignore received data, up to a limit."""
        self._received += len(data)
        if self._received > _MOST_RECEIVED:
            self.sent_data = True
            self.abort()

    def pause_writing(self) -> None:
        """Pause, because the socket is full."""
        self._paused = True

    def resume_writing(self) -> None:
        """Continue, because the socket has accepted the data in transit."""
        self._paused = False
        if self._sending is not None:
            self._written()
        self.send_on()

    def connection_lost(self, error: Exception | None) -> None:
        """Drop the queued data."""
        waiting = [*([self._sending] if self._sending is not None else []), *self._queue]
        self._queue.clear()
        self._sending = None
        self._transport = None
        for batch in waiting:
            self._group.batches.dropped(batch)
        self._group.left(self)

    def _written(self) -> None:
        batch, self._sending = self._sending, None
        assert batch is not None
        self._waiting_bytes -= len(batch.data)
        self._progress_ns = self._group.clock.now_ns()
        self._group.batches.written(batch)


def _keep_alive(sock: socket.socket) -> None:
    """Enable keep-alive, so that the kernel detects a client machine that was lost."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (("TCP_KEEPIDLE", 30), ("TCP_KEEPINTVL", 10), ("TCP_KEEPCNT", 3)):
        if hasattr(socket, option):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


_LINGER_S = 1.0


class ClientGroup:
    """Clients of one port of a server.

    Parameters
    ----------
    coder : makes the greeting; it is restarted when the last client has left.
    changed : called with True when the first client has connected, with False when the last one has left.

    Attributes
    ----------
    greeting : first data for each client.
    most_bytes : limit of the data that wait for one client; one batch more may be in transit.
    """

    def __init__(
        self,
        link: TcpLink,
        coder: ConnectionCoder,
        batches: ClientBatches,
        clock: Clock,
        changed: Callable[[bool], None],
    ) -> None:
        self._host = link.host
        self._coder = coder
        self.batches = batches
        self.clock = clock
        self._changed = changed
        self.greeting = coder.greeting
        self.most_bytes = round(link.buffer_mib * (1 << 20))
        self._admission = Admission(AllowList(link.allow))
        self._listener = Listener(self._admission, partial(Client, self))
        self._clients: dict[Client, None] = {}  # in the order in which they connected
        self._counts: Counter[str] = Counter()
        self._empty = asyncio.Event()
        self._empty.set()
        self.attend: Callable[[], None] = lambda: None

    def __len__(self) -> int:
        return len(self._clients)

    def open(self, port: int) -> None:
        """Listen; raises OSError, with the remedy, when the port cannot be opened."""
        self._listener.open(self._host, port)

    @property
    def address(self) -> str | None:
        """Host and port that it listens on."""
        at = self._listener.address
        return None if at is None else f"{at[0]}:{at[1]}"

    @property
    def counts(self) -> Mapping[str, int]:
        """Counts of clients so far, and of the events that single clients missed."""
        missed = Counter({"events that single clients missed": sum(client.missed for client in self._clients)})
        return +(self._counts + missed + self._admission.counts)

    def has_room(self, *, paced: bool) -> bool:
        """Return True if any client has room for a batch, or, in a run without pacing, all clients that read."""
        reading = [client for client in self._clients if not client.stalled]
        if paced:
            return any(client.has_room for client in reading)
        return bool(reading) and all(client.has_room for client in reading)

    def spread(self, taken: Items, data: bytes | bytearray) -> None:
        """Queue bytes for the clients that have room."""
        if not data and not len(taken.events) and not len(taken.edges):
            return
        having_room = [client for client in self._clients if client.has_room]
        for client in self._clients.keys() - having_room:
            client.missed += len(taken.events)
        batch = ClientBatch(taken, data, len(having_room))
        self.batches.begin(batch)
        for client in having_room:
            client.offer(batch)
            client.send_on()

    def give_up(self, batch: ClientBatch) -> None:
        """Close the clients for which a batch waits."""
        for client in tuple(self._clients):
            if client.holds(batch):
                self._counts["clients closed: too slow"] += 1
                client.abort()

    async def close(self) -> None:
        """Let the clients read the data in transit, and close."""
        await self._listener.close()
        if self._clients:
            self.spread(Items(empty_events(), empty_edges(), 0), self._coder.finish())
        for client in tuple(self._clients):
            client.hang_up()
        try:
            await asyncio.wait_for(self._empty.wait(), _LINGER_S)
        except TimeoutError:
            for client in tuple(self._clients):
                client.abort()
            await self._empty.wait()

    def joined(self, client: Client) -> None:
        """Add a client that has been greeted."""
        self.attend()
        self._admission.settle(client.seat)
        self._clients[client] = None
        self._counts["clients"] += 1
        self._empty.clear()
        self._changed(True)

    def left(self, client: Client) -> None:
        """Remove a client whose connection has ended."""
        self._admission.leave(client.seat)
        del self._clients[client]
        self._counts["events that single clients missed"] += client.missed
        self._counts["clients closed: sent data"] += client.sent_data
        if not self._clients:
            self._changed(False)
            self._coder.restart()  # its state belonged to them
            self._empty.set()


_MOST_EVENTS = 1 << 14  # in one batch


class TcpEndpoint(Endpoint):
    """Server of one stream on one port, and of the camera's triggers on another if the rig has one."""

    def __init__(self, link: TcpLink, wiring: Wiring, device: PlainDevice, deliveries: Deliveries) -> None:
        camera = link.camera or wiring.camera.model.upper()
        frame_us = round(link.frame_ms * 1000)
        facts = StreamFacts(wiring.camera.size, camera, frame_us, link.compression, link.pictures, link.format)
        self._link = link
        self._device = device
        self._deliveries = deliveries
        self._coder = CONNECTION_CODERS[link.format](facts)
        self._triggers = None if link.trigger_port is None else DvTriggerCoder(facts)
        self._batches = ClientBatches(device, deliveries)
        clock = deliveries.clock
        self._clients = ClientGroup(link, self._coder, self._batches, clock, device.run)
        self._trigger_clients: ClientGroup | None = None
        if self._triggers is not None:
            self._trigger_clients = ClientGroup(link, self._triggers, self._batches, clock, self._take_edges)
        self._epoch_us = 0
        device.takes_edges = self._coder.has_edges

    async def start(self) -> None:
        """Listen; raises OSError, with the remedy, when a port or a compression is not available."""
        if self._link.compression == "lz4" and find_spec("lz4") is None:
            raise OSError(f"compression needs lz4: {install_command('files')}")
        self._device.run(False)
        self._clients.open(self._link.port)
        if self._trigger_clients is not None:
            self._trigger_clients.open(self._link.trigger_port or 0)

    def pump(self) -> None:
        """Send the camera's data to the clients."""
        if (overdue := self._batches.overdue) is not None:
            for clients in self._groups:
                clients.give_up(overdue)
        paced = self._deliveries.paced
        while self._clients.has_room(paced=paced) and (taken := self._device.take(_MOST_EVENTS)) is not None:
            self._send(taken)
        if len(self._clients) and not self._device.waiting:
            nothing = Items(empty_events(), empty_edges(), self._epoch_us)
            self._clients.spread(nothing, self._coder.advance(self._device.now_us - self._epoch_us))

    def serve(self, attend: Callable[[], None]) -> None:
        """Receive the function to call before a request is processed."""
        for clients in self._groups:
            clients.attend = attend

    @property
    def longest_sleep_ns(self) -> int:
        """Longest time until the next `pump`."""
        return BUSY_NS if self._device.waiting else REST_NS

    async def close(self) -> None:
        """Let the clients read the data in transit, and close."""
        for clients in self._groups:
            await clients.close()
        self._device.run(False)

    @property
    def state(self) -> str:
        """Number of clients, or the address at which they may connect."""
        count = len(self._clients)
        if not count:
            return f"waiting for a client on {self._clients.address}"
        return f"{count} client{'s' if count > 1 else ''} on {self._clients.address}"

    def report(self) -> EndpointReport:
        """Return the address, and counts of clients so far and of the events that single clients missed."""
        triggers = {} if self._trigger_clients is None else self._trigger_clients.counts
        counts = Counter(self._clients.counts) + Counter({f"triggers: {name}": n for name, n in triggers.items()})
        return EndpointReport(self._clients.address, counts=counts)

    @property
    def _groups(self) -> list[ClientGroup]:
        return [self._clients, *([] if self._trigger_clients is None else [self._trigger_clients])]

    def _take_edges(self, has_clients: bool) -> None:
        """Let the camera take edges while any client receives them."""
        self._device.takes_edges = self._coder.has_edges or has_clients

    def _send(self, taken: Items) -> None:
        restarts = taken.epoch_us != self._epoch_us
        self._epoch_us = taken.epoch_us
        if self._triggers is not None and self._trigger_clients is not None:
            taken = self._send_triggers(taken, self._triggers, self._trigger_clients, restarts=restarts)
        restart = self._coder.restart() if restarts else b""
        data = self._coder.encode(own_time(taken.events, taken.epoch_us), own_time(taken.edges, taken.epoch_us))
        self._clients.spread(taken, restart + data if restart else data)

    def _send_triggers(self, taken: Items, coder: ConnectionCoder, clients: ClientGroup, *, restarts: bool) -> Items:
        """Send the edges to their own clients; return the rest."""
        restart = coder.restart() if restarts and len(clients) else b""
        edges = Items(empty_events(), taken.edges, taken.epoch_us)
        clients.spread(edges, restart + coder.encode(edges.events, own_time(edges.edges, edges.epoch_us)))
        return Items(taken.events, empty_edges(), taken.epoch_us)
