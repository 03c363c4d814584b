"""Datagrams to one address at a limited rate, datagrams from permitted senders, and admission of connections.

`AllowList` has the addresses that may connect to a port: single addresses and networks, written as in a rig.

    host = "127.0.0.1"                                             only programs on this machine: no list needed
    host = "192.168.1.7", allow = ["10.0.0.5", "192.168.1.0/24"]   reachable from other machines: a list is required

No peer is authenticated. A list excludes other machines of a network that is otherwise trusted.

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
import ipaddress
import socket
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

__all__ = [
    "LOOPBACK",
    "Admission",
    "AllowList",
    "ByteBudget",
    "DatagramInlet",
    "DatagramOutlet",
    "Listener",
    "Places",
    "Seat",
    "check_allow",
    "check_destination",
    "check_port",
    "is_loopback",
]


LOOPBACK = ("127.0.0.0/8", "::1/128")
"""Addresses that may connect if a rig gives no list."""

_Address = ipaddress.IPv4Address | ipaddress.IPv6Address


class AllowList:
    """Addresses and networks; raises ValueError for a text that is neither. An empty list stands for `LOOPBACK`."""

    def __init__(self, entries: Iterable[str] = ()) -> None:
        self._networks = tuple(_network(entry) for entry in tuple(entries) or LOOPBACK)

    def permits(self, address: str) -> bool:
        """Return True if a peer at a numeric address may connect; an IPv4 address inside IPv6 counts as itself."""
        try:
            peer = _plain(address)
        except ValueError:
            return False
        return any(peer in network for network in self._networks)


def is_loopback(host: str) -> bool:
    """Return True if an address to listen on certainly cannot be reached from other machines."""
    if host == "localhost":
        return True
    try:
        return _plain(host).is_loopback
    except ValueError:
        return False


def check_allow(host: str, allow: Sequence[str], key: str = "host") -> None:
    """Check a rig's `host` and `allow`; raises ValueError if other machines reach the host and no list is given."""
    try:
        AllowList(allow)
    except ValueError as error:
        raise ValueError(f"allow: {error}") from error
    if not allow and not is_loopback(host):
        where = repr(host) if host else "'', which means every address of this machine,"
        raise ValueError(
            f'{key} {where} can be reached from other machines: set allow, for example allow = ["10.0.0.5", '
            f'"192.168.1.0/24"], or use {key} = "127.0.0.1"'
        )


def check_destination(host: str, *, elsewhere: bool) -> None:
    """Check the `host` of a rig that gets data unrequested; raises ValueError for another machine not marked so."""
    if not host:
        raise ValueError("host is empty: give the receiver's address, for example 127.0.0.1")
    if not (elsewhere or is_loopback(host)):
        raise ValueError(f"host {host!r} is another machine: set elsewhere = true if that is intended")


def check_port(port: int, key: str = "port", *, least: int = 0) -> None:
    """Check a port of a rig; raises ValueError."""
    if not least <= port <= 65535:
        raise ValueError(f"{key} must be {least or '0 (any free one)'} to 65535, got {port}")


def _network(entry: str) -> ipaddress.IPv4Network | ipaddress.IPv6Network:
    try:
        return ipaddress.ip_network(entry)
    except ValueError as error:
        raise ValueError(f'{entry!r} is neither an address nor a network such as "192.168.1.0/24" ({error})') from error


def _plain(address: str) -> _Address:
    """Return an address without its zone, and an IPv4 address that is written as IPv6 as IPv4."""
    plain = ipaddress.ip_address(address.partition("%")[0])
    mapped = plain.ipv4_mapped if isinstance(plain, ipaddress.IPv6Address) else None
    return mapped or plain


_BURST_NS = 4_000_000
_LEAST_BURST_BYTES = 1500
_SEND_BUFFER = 1 << 20
_LONGEST = 1 << 16


class ByteBudget:
    """Budget of bytes that may be sent now; at most those of `burst_ns` at once."""

    def __init__(self, mbit_s: float, now_ns: int, burst_ns: int = _BURST_NS) -> None:
        self._bytes_per_ns = mbit_s / 8000
        self._most = max(_LEAST_BURST_BYTES, self._bytes_per_ns * burst_ns)
        self._now_ns = now_ns
        self.left = self._most

    def renew(self, now_ns: int) -> None:
        """Add the bytes for the time since the last call, up to a burst."""
        self.left = min(self._most, self.left + (now_ns - self._now_ns) * self._bytes_per_ns)
        self._now_ns = now_ns


class DatagramOutlet:
    """Socket that sends to one address.

    Attributes
    ----------
    counts
        Numbers of datagrams sent, refused by the receiver's machine because no program listens, and not sendable.
    """

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._socket: socket.socket | None = None
        self.counts: Counter[str] = Counter()

    @property
    def address(self) -> str:
        """Host and port of the receiver."""
        return f"{self._host}:{self._port}"

    def open(self) -> None:
        """Open the socket; raises OSError, with the remedy, when the address cannot be used."""
        try:
            family, address = _resolved(self._host, self._port)
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
            self._socket.connect(address)
        except OSError as error:
            self.close()
            raise OSError(error.errno, f"cannot send to {self._host} port {self._port}: {error.strerror}") from error

    def send(self, data: bytes) -> bool:
        """Pass a datagram to the kernel; return False if it cannot be sent.

        Raises BlockingIOError when there is no room.
        """
        assert self._socket is not None
        for _ in range(2):
            try:
                self._socket.send(data)
            except ConnectionRefusedError:  # caused by an earlier datagram: no program listens there
                self.counts["datagrams refused: no program listens"] += 1
            except BlockingIOError:
                raise
            except OSError:  # no route, no such device
                break
            else:
                self.counts["datagrams"] += 1
                return True
        self.counts["datagrams that could not be sent"] += 1
        return False

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()


class DatagramInlet:
    """Socket that receives datagrams on one address, from allowed senders only.

    Attributes
    ----------
    refused
        Number of datagrams of senders that are not allowed.
    """

    def __init__(self, host: str, port: int, allow: Iterable[str] = ()) -> None:
        self._host, self._port = host, port
        self._allow = AllowList(allow)
        self._socket: socket.socket | None = None
        self.refused = 0

    @property
    def address(self) -> str:
        """Host and port that it listens on."""
        return f"{self._host}:{self._port}"

    @property
    def descriptors(self) -> tuple[int, ...]:
        """Descriptor of the open socket, which is readable when a datagram has arrived."""
        return () if self._socket is None or self._socket.fileno() < 0 else (self._socket.fileno(),)

    def open(self, buffer_bytes: int = 0) -> None:
        """Open the socket, with a receive buffer of this size if it is not 0; raises OSError, with the remedy."""
        try:
            family, address = _resolved(self._host, self._port)
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
            if buffer_bytes:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
            self._socket.bind(address)
            self._port = self._socket.getsockname()[1]
        except OSError as error:
            self.close()
            failure = f"cannot listen on {self._host} port {self._port} (UDP): {error.strerror}"
            raise OSError(error.errno, f"{failure}; is another program there? `ss -lunp` lists it") from error

    def take(self, most: int) -> Iterator[bytes]:
        """Yield the received datagrams, at most `most`, so that a flood does not block the link's other work."""
        assert self._socket is not None
        for _ in range(most):
            try:
                data, sender = self._socket.recvfrom(_LONGEST)
            except OSError:  # no more datagrams, or an error from a peer's socket
                return
            if self._allow.permits(str(sender[0])):
                yield data
            else:
                self.refused += 1

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()


def _resolved(host: str, port: int) -> tuple[int, Any]:
    found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    family, _, _, _, address = min(found, key=lambda one: one[0] != socket.AF_INET)  # localhost is 127.0.0.1
    return family, address


@dataclass(frozen=True)
class Places:
    """Limits of simultaneous connections.

    Attributes
    ----------
    total
        Limit for all addresses together.
    per_address
        Limit for one address.
    """

    total: int = 64
    per_address: int = 16


@dataclass(eq=False)
class Seat:
    """Admitted connection; `evict` closes it at once."""

    address: str
    evict: Callable[[], None]


class Admission:
    """Admission of the connections of one server.

    Attributes
    ----------
    counts
        Numbers of connections that were refused or closed for another one, by their names in the summary.
    """

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
        mine = sum(seat.address == address for seat in chain(self._idle, self._settled))
        if mine >= self._places.per_address:
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
