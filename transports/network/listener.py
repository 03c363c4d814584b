"""TCP port that passes on the connections of allowed peers, a few at a time, and refuses the others.

asyncio's own server accepts a hundred connections in one turn of the loop and builds a transport for each before a
connection can be refused; a flood would then delay the other work of the loop. Here a refused connection costs an
accept and a close. So few are accepted in one turn that a new one with an immediate request is served before a flood
can take its place.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable

from transports.network.datagrams import Admission, Seat

__all__ = ["Listener"]

_BACKLOG = 128
_AT_A_TIME = 4  # accepted in one turn of the loop; a quarter of the places of one address


class Listener:
    """Listener on one address.

    Parameters
    ----------
    admission
        Permitted addresses, and limits of connections.
    protocol
        Makes the protocol of a connection that was admitted; it calls `Admission.leave` when the connection has ended.
    farewell
        Bytes sent to a peer that finds no place; one whose address is not allowed receives nothing.
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
        """Listen on one address, 0 for any free port; raises OSError when the address cannot be used."""
        if not host:
            raise OSError("an empty host would listen on every address of this machine")
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        family, _, _, _, address = min(found, key=lambda one: one[0] != socket.AF_INET)  # localhost is 127.0.0.1
        self._socket = socket.create_server((str(address[0]), port), family=family, backlog=_BACKLOG)
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
