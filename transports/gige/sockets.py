"""The camera's sockets: one for control, one that hears searches by broadcast, one for the stream."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterable, Iterator
from contextlib import suppress

from firmware_protocol.gige.control import Datagram, Peer
from firmware_protocol.gige.gvsp import HEADER_OCTETS, Block
from transports.network.datagrams import AllowList

__all__ = ["ControlSockets", "StreamSocket"]

_LONGEST = 2048
_AT_A_TIME = 64
_SEND_BUFFER = 1 << 21
_BROADCAST = "255.255.255.255"
_IP_MTU_DISCOVER, _PMTUDISC_DONT, _PMTUDISC_DO = 10, 0, 2  # Linux: linux/in.h
_UDP_SEGMENT, _MOST_SEGMENTS, _LONGEST_RUN = 103, 64, 65_507  # Linux: linux/udp.h


class ControlSockets:
    """Takes requests from allowed senders and sends the answers.

    A socket bound to one address does not hear broadcasts on Linux, so there is another one, bound to the address of
    all machines; hosts search by broadcast on a loopback interface too.

    Attributes
    ----------
    refused
        Datagrams of senders that are not allowed.
    """

    def __init__(self, host: str, port: int, allow: Iterable[str]) -> None:
        self._host, self._port = host, port
        self._allow = AllowList(allow)
        self._sockets: list[socket.socket] = []
        self.refused = 0

    def open(self) -> None:
        """Open them; raises OSError, with what to do, where another program has the port."""
        try:
            self._sockets.append(_bound(self._host, self._port, shared=False))
            self._port = self._sockets[0].getsockname()[1]
            self._sockets.append(_bound(_BROADCAST, self._port, shared=True))
        except OSError as error:
            self.close()
            told = f"cannot listen on {self._host} port {self._port} (UDP): {error.strerror}"
            cure = "another camera may be there: give this one an address of its own, such as 127.0.0.2"
            raise OSError(error.errno, f"{told}; {cure}") from error

    @property
    def port(self) -> int:
        """Where hosts find the camera."""
        return self._port

    @property
    def descriptors(self) -> list[int]:
        """File descriptors, for an event loop."""
        return [one.fileno() for one in self._sockets]

    def take(self) -> list[Datagram]:
        """Return what has come, at most so much that a flood does not keep the answers waiting for long."""
        taken: list[Datagram] = []
        for one in self._sockets:
            for _ in range(_AT_A_TIME):
                try:
                    data, peer = one.recvfrom(_LONGEST)
                except OSError:  # no more, or the complaint of another socket
                    break
                if self._allow.permits(peer[0]):
                    taken.append((data, peer))
                else:
                    self.refused += 1
        return taken

    def send(self, data: bytes, peer: Peer) -> None:
        """Send an answer; one that cannot go is lost, as on a cable."""
        try:
            self._sockets[0].sendto(data, peer)
        except OSError:
            return

    def close(self) -> None:
        """Close them."""
        for one in self._sockets:
            one.close()
        self._sockets.clear()


class StreamSocket:
    """Sends the packets of the stream.

    Parameters
    ----------
    segmented
        Whether the kernel, or the network card, cuts what `send_block` gives it into packets.
    """

    def __init__(self, host: str, *, segmented: bool = False) -> None:
        self._host = host
        self._segmented = segmented
        self._socket: socket.socket | None = None
        self._whole = True

    def open(self) -> int:
        """Open it and return its port; raises OSError."""
        self._socket = _bound(self._host, 0, shared=False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self._refuse_cuts(True)
        return int(self._socket.getsockname()[1])

    def send(self, data: bytes, to: tuple[str, int], *, may_fragment: bool) -> bool:
        """Give the kernel a packet; False when it cannot go at all. Raises BlockingIOError when there is no room."""
        assert self._socket is not None
        if may_fragment == self._whole:
            self._refuse_cuts(not may_fragment)
        try:
            self._socket.sendto(data, to)
        except BlockingIOError:
            raise
        except OSError:  # longer than the network carries, no route
            return False
        return True

    def take(self) -> list[Datagram]:
        """Return what hosts sent to this socket: answers to messages; not too much of it."""
        assert self._socket is not None
        taken: list[Datagram] = []
        with suppress(OSError):  # no more, or the complaint of a host that has gone
            for _ in range(_AT_A_TIME):
                taken.append(self._socket.recvfrom(_LONGEST))
        return taken

    def send_block(self, block: Block, to: tuple[str, int], *, may_fragment: bool) -> int:
        """Give the kernel the packets of a block; returns how many it took, in order, before one did not go."""
        assert self._socket is not None
        if may_fragment == self._whole:
            self._refuse_cuts(not may_fragment)
        taken, cut = 0, struct.pack("=H", block.room + HEADER_OCTETS)
        try:
            for data, count in _runs(block) if self._segmented else _singles(block):
                if count == 1:
                    self._socket.sendto(data, to)
                else:
                    self._socket.sendmsg((data,), [(socket.IPPROTO_UDP, _UDP_SEGMENT, cut)], 0, to)
                taken += count
        except OSError:
            return taken
        return taken

    def close(self) -> None:
        """Close it."""
        if self._socket is not None:
            self._socket.close()

    def _refuse_cuts(self, whole: bool) -> None:
        assert self._socket is not None
        self._whole = whole
        self._socket.setsockopt(socket.IPPROTO_IP, _IP_MTU_DISCOVER, _PMTUDISC_DO if whole else _PMTUDISC_DONT)


def _singles(block: Block) -> Iterator[tuple[bytes, int]]:
    """Give the packets of a block, and 1 for each."""
    return ((block.packet(number), 1) for number in range(block.packets))


def _runs(block: Block) -> Iterator[tuple[bytes, int]]:
    """Give the packets of a block, those with payload end to end in runs that the kernel takes, and how many."""
    most = min(_MOST_SEGMENTS, _LONGEST_RUN // (block.room + HEADER_OCTETS))
    last = block.packets - 1
    yield block.packet(0), 1
    for first in range(1, last, most):
        count = min(most, last - first)
        yield b"".join(block.packet(number) for number in range(first, first + count)), count
    yield block.packet(last), 1


def _bound(host: str, port: int, *, shared: bool) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        made.setblocking(False)
        if shared:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind((host, port))
    except OSError:
        made.close()
        raise
    return made
