"""Admission of connections to a TCP port.

`Admission` limits the connections of a server: a list of allowed addresses, a total, a share for each address.

    idle      connected, without a request so far; closed when a newer one needs its place, the oldest of the
              address with the most idle connections first
    settled   uses the service; never closed for another one

So a flood from one address does not affect the connections of the others, and never a settled one.

`Listener` is a TCP port that passes on the connections of allowed peers, a few at a time, and refuses the others.

asyncio's own server accepts a hundred connections in one turn of the loop and builds a transport for each before a
connection can be refused; a flood would then delay the other work of the loop. Here a refused connection costs an
accept and a close. So few are accepted in one turn that a new one with an immediate request is served before a flood
can take its place.
"""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain

from transports.network import AllowList


@dataclass(frozen=True)
class Places:
    """Limits of simultaneous connections: `total` for all addresses together, `per_address` for one address."""

    total: int = 64
    per_address: int = 16


@dataclass(eq=False)
class Seat:
    """Admitted connection; `evict` closes it at once."""

    address: str
    evict: Callable[[], None]


class Admission:
    """Admission of a server's connections; `counts`: those refused or closed for another one, by their names."""

    def __init__(self, allowed: AllowList, places: Places = Places()) -> None:
        self._allowed = allowed
        self._places = places
        self._idle: dict[Seat, None] = {}  # oldest first
        self._settled: set[Seat] = set()
        self.counts: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._idle) + len(self._settled)

    def permits(self, address: str) -> bool:
        """Return True if an address may connect; a refusal is counted."""
        permitted = self._allowed.permits(address)
        self.counts["connections refused: address not allowed"] += not permitted
        return permitted

    def admit(self, address: str, evict: Callable[[], None]) -> Seat | None:
        """Give a new connection a place, if necessary that of an idle connection; None (counted) when there is none."""
        if not self._make_place(address):
            self.counts["connections refused: too many"] += 1
            return None
        seat = Seat(address, evict)
        self._idle[seat] = None
        return seat

    def settle(self, seat: Seat) -> None:
        """Mark a connection as settled: it uses the service."""
        if seat in self._idle:
            del self._idle[seat]
            self._settled.add(seat)

    def leave(self, seat: Seat) -> None:
        """Remove a connection that has ended."""
        self._idle.pop(seat, None)
        self._settled.discard(seat)

    def _make_place(self, address: str) -> bool:
        count = sum(seat.address == address for seat in chain(self._idle, self._settled))
        if count >= self._places.per_address:
            return self._evict(address)
        if len(self) < self._places.total:
            return True
        idle = Counter(seat.address for seat in self._idle)
        return bool(idle) and self._evict(idle.most_common(1)[0][0])

    def _evict(self, address: str) -> bool:
        """Close the oldest idle connection of an address; return False when it has none."""
        seat = next((seat for seat in self._idle if seat.address == address), None)
        if seat is None:
            return False
        self.leave(seat)
        self.counts["idle connections closed for newer ones"] += 1
        seat.evict()
        return True


_BACKLOG = 128
_AT_A_TIME = 4  # accepted in one turn of the loop; a quarter of the places of one address


class Listener:
    """Listener on one address.

    Parameters
    ----------
    admission : permitted addresses, and limits of connections.
    protocol
        Makes the protocol of a connection that was admitted; it calls `Admission.leave` when the connection has ended.
    farewell : bytes sent to a peer that finds no place; one whose address is not allowed receives nothing.
    """

    def __init__(
        self, admission: Admission, protocol: Callable[[Seat], asyncio.BaseProtocol], farewell: bytes = b""
    ) -> None:
        self._admission = admission
        self._protocol = protocol
        self._farewell = farewell
        self._socket: socket.socket | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def address(self) -> tuple[str, int] | None:
        """Host and port of the listener; None while it is closed."""
        if self._socket is None:
            return None
        host, port = self._socket.getsockname()[:2]
        return str(host), int(port)

    def open(self, host: str, port: int) -> None:
        """Listen on one address, 0 for any free port; raises OSError, with the remedy, when it cannot be used."""
        if not host:
            raise OSError("an empty host would listen on every address of this machine")
        try:
            addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
            # IPv4 first: localhost is 127.0.0.1
            family, _, _, _, address = min(addresses, key=lambda info: info[0] != socket.AF_INET)
            self._socket = socket.create_server((str(address[0]), port), family=family, backlog=_BACKLOG)
        except OSError as error:
            remedy = "another program may use it: stop that one, or give this link another port (0 takes a free one)"
            reason = f"cannot listen on {host} port {port}: {error.strerror or error}"
            raise OSError(error.errno, f"{reason}; {remedy}") from error
        self._socket.setblocking(False)
        asyncio.get_running_loop().add_reader(self._socket, self._accept)

    async def close(self) -> None:
        """Stop listening; admitted connections are passed on before, and stay."""
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket)
            self._socket.close()
            self._socket = None
        await asyncio.gather(*self._tasks)

    def _accept(self) -> None:
        assert self._socket is not None
        if self._tasks:  # the preceding ones do not have their protocol yet
            return
        for _ in range(_AT_A_TIME):
            try:
                peer, address = self._socket.accept()
            except OSError:  # no connection waits, or the waiting one was closed
                return
            self._receive(peer, str(address[0]))

    def _receive(self, peer: socket.socket, address: str) -> None:
        peer.setblocking(False)
        if not self._admission.permits(address):
            peer.close()
            return
        connection = _Pending(peer)
        seat = self._admission.admit(address, connection.abort)
        if seat is None:
            connection.refuse(self._farewell)
            return
        task = asyncio.get_running_loop().create_task(self._hand_over(connection, seat))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _hand_over(self, connection: _Pending, seat: Seat) -> None:
        if connection.aborted:
            connection.socket.close()
            return
        loop = asyncio.get_running_loop()
        transport, _ = await loop.connect_accepted_socket(lambda: self._protocol(seat), connection.socket)
        connection.transport = transport
        if connection.aborted:
            transport.abort()


class _Pending:
    """Connection after its accept, which can be aborted before it has a transport."""

    def __init__(self, peer: socket.socket) -> None:
        self.socket = peer
        self.transport: asyncio.Transport | None = None
        self.aborted = False

    def abort(self) -> None:
        self.aborted = True
        if self.transport is not None:
            self.transport.abort()

    def refuse(self, farewell: bytes) -> None:
        with self.socket:
            try:
                self.socket.send(farewell)
            except OSError:
                return
