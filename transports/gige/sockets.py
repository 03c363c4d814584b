"""Sockets of the camera: one for control, one that receives discovery broadcasts, one for the stream."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterable, Iterator
from contextlib import suppress

from firmware_protocol.gige.control import Datagram, Peer
from firmware_protocol.gige.gvsp import HEADER_OCTETS, Block
from transports.network import AllowList

_LONGEST = 2048
_AT_A_TIME = 64
_SEND_BUFFER = 1 << 21
_BROADCAST = "255.255.255.255"
# Linux: linux/in.h and linux/udp.h
_IP_MTU_DISCOVER = 10
_PMTUDISC_DONT, _PMTUDISC_DO = 0, 2
_UDP_SEGMENT = 103
_MOST_SEGMENTS, _LONGEST_RUN = 64, 65_507


class ControlSockets:
    """Sockets that receive requests of permitted senders and send the answers.

    `refused`: number of datagrams of other senders. A socket bound to one address does not receive broadcasts on Linux.
    So a second one is bound to the broadcast address; hosts search by broadcast on a loopback interface too.
    """

    def __init__(self, host: str, port: int, allow: Iterable[str]) -> None:
        self._host, self.port = host, port
        self._allow = AllowList(allow)
        self._sockets: list[socket.socket] = []
        self.refused = 0

    def open(self) -> None:
        """Open the sockets; raises OSError, with the remedy, if another program uses the port."""
        try:
            self._sockets.append(_bound(self._host, self.port, shared=False))
            self.port = self._sockets[0].getsockname()[1]
            self._sockets.append(_bound(_BROADCAST, self.port, shared=True))
        except OSError as error:
            self.close()
            failure = f"cannot listen on {self._host} port {self.port} (UDP): {error.strerror}"
            cure = "another camera may be there: give this one an address of its own, such as 127.0.0.2"
            raise OSError(error.errno, f"{failure}; {cure}") from error

    @property
    def descriptors(self) -> list[int]:
        """File descriptors, for an event loop."""
        return [sock.fileno() for sock in self._sockets]

    def take(self) -> list[Datagram]:
        """Return the received requests; their number is limited, so that a flood does not delay the answers."""
        taken: list[Datagram] = []
        for sock in self._sockets:
            for _ in range(_AT_A_TIME):
                try:
                    data, peer = sock.recvfrom(_LONGEST)
                except OSError:  # no more requests, or an error from a peer's socket
                    break
                if self._allow.permits(peer[0]):
                    taken.append((data, peer))
                else:
                    self.refused += 1
        return taken

    def send(self, data: bytes, peer: Peer) -> None:
        """Send an answer; one that cannot be sent is lost, as on a cable."""
        try:
            self._sockets[0].sendto(data, peer)
        except OSError:
            return

    def close(self) -> None:
        """Close the sockets."""
        for sock in self._sockets:
            sock.close()
        self._sockets.clear()


class StreamSocket:
    """Socket that sends the stream's packets; `segmented`: kernel or network card divide the data of `send_block`."""

    def __init__(self, host: str, *, segmented: bool = False) -> None:
        self._host = host
        self._segmented = segmented
        self._socket: socket.socket | None = None
        self._whole = True

    def open(self) -> int:
        """Open the socket and return its port; raises OSError."""
        self._socket = _bound(self._host, 0, shared=False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self._refuse_cuts(True)
        return int(self._socket.getsockname()[1])

    def send(self, data: bytes, to: Peer, *, may_fragment: bool) -> bool:
        """Pass a packet to the kernel; False if it cannot be sent. Raises BlockingIOError when there is no room."""
        assert self._socket is not None
        if may_fragment == self._whole:
            self._refuse_cuts(not may_fragment)
        try:
            self._socket.sendto(data, to)
        except BlockingIOError:
            raise
        except OSError:  # longer than the network's limit, or no route
            return False
        return True

    def take(self) -> list[Datagram]:
        """Return the answers of hosts to messages; their number is limited."""
        assert self._socket is not None
        taken: list[Datagram] = []
        with suppress(OSError):  # no more answers, or an error from a host that has closed
            for _ in range(_AT_A_TIME):
                taken.append(self._socket.recvfrom(_LONGEST))
        return taken

    def send_block(self, block: Block, to: Peer, *, may_fragment: bool) -> int:
        """Pass a block's packets to the kernel; return the number of packets taken before the first refused one."""
        assert self._socket is not None
        if may_fragment == self._whole:
            self._refuse_cuts(not may_fragment)
        taken, cut = 0, struct.pack("=H", block.room + HEADER_OCTETS)
        singles = ((block.packet(number), 1) for number in range(block.packets))
        try:
            for data, count in _runs(block) if self._segmented else singles:
                if count == 1:
                    self._socket.sendto(data, to)
                else:
                    self._socket.sendmsg((data,), [(socket.IPPROTO_UDP, _UDP_SEGMENT, cut)], 0, to)
                taken += count
        except OSError:
            return taken
        return taken

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()

    def _refuse_cuts(self, refuse: bool) -> None:
        assert self._socket is not None
        self._whole = refuse
        self._socket.setsockopt(socket.IPPROTO_IP, _IP_MTU_DISCOVER, _PMTUDISC_DO if refuse else _PMTUDISC_DONT)


def _runs(block: Block) -> Iterator[tuple[bytes, int]]:
    """Yield packets of a block with their count, those with payload in the longest runs that the kernel takes."""
    longest_run = min(_MOST_SEGMENTS, _LONGEST_RUN // (block.room + HEADER_OCTETS))
    last = block.packets - 1
    yield block.packet(0), 1
    for first in range(1, last, longest_run):
        count = min(longest_run, last - first)
        yield b"".join(block.packet(number) for number in range(first, first + count)), count
    yield block.packet(last), 1


def _bound(host: str, port: int, *, shared: bool) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.setblocking(False)
        if shared:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((host, port))
    except OSError:
        sock.close()
        raise
    return sock
