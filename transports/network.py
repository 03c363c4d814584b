"""Datagrams to one address at a limited rate, datagrams from permitted senders, and permitted addresses.

`AllowList` has the addresses that may connect to a port: single addresses and networks, written as in a rig.

    host = "127.0.0.1"                                             only programs on this machine: no list needed
    host = "192.168.1.7", allow = ["10.0.0.5", "192.168.1.0/24"]   reachable from other machines: a list is required

No peer is authenticated. A list excludes other machines of a network that is otherwise trusted.

Nothing here needs an event loop: the process that answers the hosts of a GigE link imports no asyncio.
"""

from __future__ import annotations

import ipaddress
import socket
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Any

from msgspec import Meta

LOOPBACK = ("127.0.0.0/8", "::1/128")
"""Addresses that may connect if a rig gives no list."""

DestinationPort = Annotated[int, Meta(ge=1, le=65535)]
"""Port that data are sent to."""

DatagramRate = Annotated[float, Meta(ge=0.1, le=100_000)]
"""Highest rate of datagrams, Mbit/s of payload."""

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


class _DatagramSocket:
    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._socket: socket.socket | None = None

    @property
    def address(self) -> str:
        """Host and port."""
        return f"{self._host}:{self._port}"

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()


class DatagramOutlet(_DatagramSocket):
    """Socket that sends to one address.

    `counts`: datagrams sent, refused by the receiver's machine because no program listens, and not sendable.
    """

    def __init__(self, host: str, port: int) -> None:
        super().__init__(host, port)
        self.counts: Counter[str] = Counter()

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
        """Pass a datagram to the kernel; False if it cannot be sent. Raises BlockingIOError when there is no room."""
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


class DatagramInlet(_DatagramSocket):
    """Socket that receives datagrams on one address from allowed senders only; `refused`: number of the others."""

    def __init__(self, host: str, port: int, allow: Iterable[str] = ()) -> None:
        super().__init__(host, port)
        self._allow = AllowList(allow)
        self.refused = 0

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

    def take(self, limit: int) -> Iterator[bytes]:
        """Yield the received datagrams, at most `limit`, so that a flood does not block the link's other work."""
        assert self._socket is not None
        for _ in range(limit):
            try:
                data, sender = self._socket.recvfrom(_LONGEST)
            except OSError:  # no more datagrams, or an error from a peer's socket
                return
            if self._allow.permits(str(sender[0])):
                yield data
            else:
                self.refused += 1


def _resolved(host: str, port: int) -> tuple[int, Any]:
    addresses = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    family, _, _, _, address = min(addresses, key=lambda info: info[0] != socket.AF_INET)  # localhost is 127.0.0.1
    return family, address
