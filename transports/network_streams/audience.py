"""The clients of one port, who all get the same bytes from the moment they connect."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping

from firmware_protocol.edges import empty_edges
from firmware_protocol.events import empty_events
from firmware_protocol.network_streams.coder import ConnectionCoder
from firmware_protocol.plain_device import Taken
from transports.link.pacing import Clock
from transports.network.admission import Admission, Seat
from transports.network.allow import AllowList
from transports.network.listener import Listener
from transports.network_streams.client import Client, ClientTerms
from transports.network_streams.fates import Batch, Fates
from transports.network_streams.parameters import TcpStream

__all__ = ["Audience"]

_LINGER_S = 1.0


class Audience:
    """A server's clients.

    Parameters
    ----------
    coder
        Makes the greeting; told to begin anew when the last client has gone.
    changed
        Called with True when the first client has come, with False when the last one has gone.
    """

    def __init__(
        self, link: TcpStream, coder: ConnectionCoder, fates: Fates, clock: Clock, changed: Callable[[bool], None]
    ) -> None:
        self._host, self._coder, self._fates, self._clock = link.host, coder, fates, clock
        self._changed = changed
        self._terms = ClientTerms(coder.greeting, round(link.buffer_mib * (1 << 20)))
        self._admission = Admission(AllowList(link.allow))
        self._listener = Listener(self._admission, self._connect)
        self._clients: dict[Client, Seat] = {}
        self._counts: Counter[str] = Counter()
        self._empty = asyncio.Event()
        self._empty.set()

    def __len__(self) -> int:
        """Return how many clients there are."""
        return len(self._clients)

    def open(self, port: int) -> None:
        """Listen; raises OSError, with what to do, when the port cannot be had."""
        try:
            self._listener.open(self._host, port)
        except OSError as error:
            raise OSError(
                error.errno,
                f"cannot listen on {self._host} port {port}: {error.strerror or error}; another program may hold "
                "it: stop that one, or give this link another port (0 takes a free one)",
            ) from error

    @property
    def address(self) -> str | None:
        """Host and port that it listens on."""
        at = self._listener.address
        return None if at is None else f"{at[0]}:{at[1]}"

    @property
    def counts(self) -> Mapping[str, int]:
        """Clients so far, and what single ones missed."""
        missed = sum(client.missed for client in self._clients)
        missed_by_slow = Counter({"events that single clients missed": missed})
        return +(self._counts + missed_by_slow + self._admission.counts)

    def has_room(self, *, paced: bool) -> bool:
        """Say whether a batch may come: any client has room for it, or, in a run that is not paced, all that read."""
        reading = [client for client in self._clients if not client.stalled]
        if paced:
            return any(client.has_room for client in reading)
        return bool(reading) and all(client.has_room for client in reading)

    def spread(self, taken: Taken, data: bytes | bytearray) -> None:
        """Give bytes to the clients that have room."""
        if not data and not len(taken.events) and not len(taken.edges):
            return
        having_room = [client for client in self._clients if client.has_room]
        for client in self._clients.keys() - having_room:
            client.missed += len(taken.events)
        batch = Batch(taken, data, len(having_room))
        self._fates.begin(batch)
        for client in having_room:
            client.offer(batch)
            client.send_on()

    def give_up(self, batch: Batch) -> None:
        """Close the clients that a batch waits for."""
        for client in tuple(self._clients):
            if client.holds(batch):
                self._counts["clients closed: too slow"] += 1
                client.abort()

    async def close(self) -> None:
        """Let the clients take what is on its way to them, and close."""
        await self._listener.close()
        if self._clients:
            self.spread(Taken(empty_events(), empty_edges(), 0), self._coder.finish())
        for client in tuple(self._clients):
            client.hang_up()
        try:
            await asyncio.wait_for(self._empty.wait(), _LINGER_S)
        except TimeoutError:
            for client in tuple(self._clients):
                client.abort()
            await self._empty.wait()

    def _connect(self, seat: Seat) -> Client:
        def joined(client: Client) -> None:
            self._admission.settle(seat)
            self._clients[client] = seat
            self._counts["clients"] += 1
            self._empty.clear()
            self._changed(True)

        return Client(self._terms, self._fates, self._clock, joined, self._forget)

    def _forget(self, client: Client) -> None:
        self._admission.leave(self._clients.pop(client))
        self._counts["events that single clients missed"] += client.missed
        self._counts["clients closed: sent data"] += client.talked
        if not self._clients:
            self._changed(False)
            self._coder.restart()  # what it holds was for them
            self._empty.set()
