"""Datagrams out to one address, no faster than a rate, and datagrams in from those who may send them."""

from __future__ import annotations

import socket
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

from transports.network.allow import AllowList

__all__ = ["ByteBudget", "DatagramInlet", "DatagramOutlet"]

_BURST_NS = 4_000_000
_LEAST_BURST_BYTES = 1500
_SEND_BUFFER = 1 << 20
_LONGEST = 1 << 16


class ByteBudget:
    """Bytes that may go now; at most those of `burst_ns` at once."""

    def __init__(self, mbit_s: float, now_ns: int, burst_ns: int = _BURST_NS) -> None:
        self._bytes_per_ns = mbit_s / 8000
        self._most = max(_LEAST_BURST_BYTES, self._bytes_per_ns * burst_ns)
        self._now_ns = now_ns
        self.left = self._most

    def renew(self, now_ns: int) -> None:
        """Add what the time since the last call has brought, up to a burst."""
        self.left = min(self._most, self.left + (now_ns - self._now_ns) * self._bytes_per_ns)
        self._now_ns = now_ns


class DatagramOutlet:
    """A socket that sends to one address.

    Attributes
    ----------
    counts
        Datagrams; those that the receiver's machine refused, because nobody listens, and those that could not go.
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
        """Open the socket; raises OSError, with what to do, when the address cannot be used."""
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
        """Give the kernel a datagram; False when it cannot go at all. Raises BlockingIOError when there is no room."""
        assert self._socket is not None
        for _ in range(2):
            try:
                self._socket.send(data)
            except ConnectionRefusedError:  # of an earlier one: nobody listens there
                self.counts["datagrams refused: nobody listens"] += 1
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
    """A socket that takes datagrams on one address, from allowed senders only.

    Attributes
    ----------
    refused
        Datagrams of senders that are not allowed.
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

    def open(self, buffer_bytes: int = 0) -> None:
        """Open the socket, with a receive buffer of this size where it is not 0; raises OSError, with what to do."""
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
            told = f"cannot listen on {self._host} port {self._port} (UDP): {error.strerror}"
            raise OSError(error.errno, f"{told}; is another program there? `ss -lunp` tells") from error

    def take(self, most: int) -> Iterator[bytes]:
        """Give what has come, at most so many datagrams: a flood must not keep the link from its own work."""
        assert self._socket is not None
        for _ in range(most):
            try:
                data, sender = self._socket.recvfrom(_LONGEST)
            except OSError:  # no more, or the complaint of another socket
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
