"""Port of the Precision Time Protocol: sockets with time stamps of the kernel, around a `Slave`.

    group 224.0.1.129 --319, 320--> PtpSockets --octets, local time--> Slave
    group 224.0.1.129 <-------319-- PtpSockets <--------Delay_Req----- Slave
                                        |
                                        +--time at which it left--> Slave

The kernel stamps a packet by CLOCK_REALTIME when the network driver takes it or gives it, so a busy machine does not
delay the stamps. The local clock of the slave is CLOCK_MONOTONIC, which the run uses too; a stamp is moved there by the
difference of both clocks at the time of reading. No clock of the machine is set.

Source: Linux, Documentation/networking/timestamping.rst.
"""

from __future__ import annotations

import random
import socket
import struct
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress

from firmware_protocol.ptp.messages import EVENT_PORT, GENERAL_PORT, GROUP
from firmware_protocol.ptp.slave import PortState, Slave
from transports.link.pacing import wall_less_monotonic_ns
from transports.network import AllowList

_LONGEST = 1500
_AT_A_TIME = 64
_SO_TIMESTAMPING = 37  # Linux: asm-generic/socket.h
_IP_MULTICAST_ALL = 49  # Linux: linux/in.h
_ERROR_QUEUE = 0x2000  # Linux: MSG_ERRQUEUE
_TX_SOFTWARE = 1 << 1  # Linux: linux/net_tstamp.h
_RX_SOFTWARE = 1 << 3
_SOFTWARE = 1 << 4
_STAMP_ONLY = 1 << 11
_STAMPS = struct.Struct("@ll")
_CONTROL_OCTETS = 512
_RETRY_NS = 4_000_000_000


class PtpSockets:
    """Sockets of one address: an event and a general port, each for the group and for the address itself.

    `counts`: datagrams that were dropped, by reason. The kernel begins to stamp a moment after the sockets are opened.
    Raises OSError, with the remedy, if the ports cannot be used.
    """

    def __init__(self, host: str, allow: Iterable[str]) -> None:
        self._allow = AllowList(allow)
        self._sockets: list[tuple[socket.socket, bool]] = []
        self.counts: Counter[str] = Counter()
        try:
            self._event = self._opened(host, host, EVENT_PORT)
            self._opened(GROUP, host, EVENT_PORT)
            self._opened(host, host, GENERAL_PORT)
            self._opened(GROUP, host, GENERAL_PORT)
        except OSError as error:
            self.close()
            failure = f"cannot use UDP ports {EVENT_PORT} and {GENERAL_PORT} of {host} for PTP: {error.strerror}"
            cure = "run as root or with CAP_NET_BIND_SERVICE, or set ptp = false"
            raise OSError(error.errno, f"{failure}; {cure}") from error

    @property
    def descriptors(self) -> list[int]:
        """File descriptors, for an event loop."""
        return [sock.fileno() for sock, _ in self._sockets]

    def take(self) -> Iterator[tuple[bytes, int]]:
        """Yield the received datagrams and their times by CLOCK_MONOTONIC, ns; event messages first."""
        ahead_ns = wall_less_monotonic_ns()
        for sock, is_event in self._sockets:
            for _ in range(_AT_A_TIME):
                try:
                    data, control, _, peer = sock.recvmsg(_LONGEST, _CONTROL_OCTETS)
                except OSError:  # no more of them, or an error from a peer's socket
                    break
                stamp_ns = _stamp_ns(control)
                if not self._allow.permits(peer[0]):
                    self.counts["ptp messages of senders not allowed"] += 1
                elif stamp_ns is not None:
                    yield data, stamp_ns - ahead_ns
                elif is_event:
                    self.counts["ptp messages without a time stamp"] += 1
                else:
                    yield data, time.monotonic_ns()

    def send(self, data: bytes) -> None:
        """Send an event message to the group; raises OSError."""
        self._event.sendto(data, (GROUP, EVENT_PORT))

    def sent_ns(self) -> int | None:
        """Return the time by CLOCK_MONOTONIC, ns, at which the last message left; None if that is not known yet."""
        left_ns = None
        with suppress(OSError):  # no more of them
            while True:
                _, control, _, _ = self._event.recvmsg(_LONGEST, _CONTROL_OCTETS, _ERROR_QUEUE)
                left_ns = _stamp_ns(control)
        return None if left_ns is None else left_ns - wall_less_monotonic_ns()

    def close(self) -> None:
        """Close the sockets."""
        for sock, _ in self._sockets:
            sock.close()
        self._sockets.clear()

    def _opened(self, address: str, host: str, port: int) -> socket.socket:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sockets.append((sock, port == EVENT_PORT))
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
        sock.bind((address, port))
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(host))
        if address == GROUP:
            joined = socket.inet_aton(GROUP) + socket.inet_aton(host)
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, joined)
        if port == EVENT_PORT:
            flags = _TX_SOFTWARE | _RX_SOFTWARE | _SOFTWARE | _STAMP_ONLY
            sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPING, flags)
        return sock


class PtpPort:
    """A slave and its sockets; where they fail, the port is faulty and is opened again every four seconds.

    Raises OSError, with the remedy, if the ports cannot be used at first.
    """

    def __init__(self, slave: Slave, host: str, allow: tuple[str, ...]) -> None:
        self._slave = slave
        self._host, self._allow = host, allow
        self._sockets: PtpSockets | None = PtpSockets(host, allow)
        self._counts: Counter[str] = Counter()
        self._failed_ns = 0

    @property
    def descriptors(self) -> list[int]:
        """File descriptors, for an event loop; others after each `turn` that returns True."""
        return [] if self._sockets is None else self._sockets.descriptors

    @property
    def counts(self) -> Counter[str]:
        """Datagrams that were dropped, by reason."""
        return self._counts if self._sockets is None else self._counts + self._sockets.counts

    def turn(self, *, is_mute: bool = False) -> bool:
        """Receive and send what is due; True if the sockets are new. `is_mute` discards messages: no cable."""
        if self._sockets is None:
            return self._opened_again(time.monotonic_ns())
        left_ns = self._sockets.sent_ns()
        if left_ns is not None:
            self._slave.sent(left_ns)
        for data, local_ns in self._sockets.take():
            if not is_mute:
                self._slave.receive(data, local_ns)
        request = self._slave.advance(time.monotonic_ns())
        if request is None or is_mute:
            return False
        try:
            self._sockets.send(request)
        except OSError:
            self._fail()
            return True
        return False

    def move(self, host: str) -> None:
        """Use another address from the next `turn` on."""
        self._host = host
        self._fail()
        self._failed_ns = 0

    def _fail(self) -> None:
        if self._sockets is not None:
            self._counts += self._sockets.counts
            self._sockets.close()
            self._sockets = None
        self._failed_ns = time.monotonic_ns()
        if self._slave.state != PortState.DISABLED:
            self._slave.fail()

    def _opened_again(self, now_ns: int) -> bool:
        if now_ns - self._failed_ns < _RETRY_NS:
            return False
        try:
            self._sockets = PtpSockets(self._host, self._allow)
        except OSError:
            self._failed_ns = now_ns
            return False
        if self._slave.state == PortState.FAULTY:
            self._slave.enable()
        return True


def ptp_slave(identity: int, domain: int) -> Slave:
    """Return the slave of a camera; its pauses are drawn by its identity."""
    return Slave(identity, domain, random.Random(identity).random)


def _stamp_ns(control: list[tuple[int, int, bytes]]) -> int | None:
    """Return the kernel's stamp, CLOCK_REALTIME; None without one."""
    for level, kind, data in control:
        if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPING) and len(data) >= _STAMPS.size:
            seconds, nanoseconds = _STAMPS.unpack_from(data)
            return int(seconds) * 1_000_000_000 + int(nanoseconds)
    return None
