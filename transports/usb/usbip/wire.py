"""A host's end of a USB/IP connection: requests go out, whole replies come in, faults get a name."""

from __future__ import annotations

import socket
import time

from firmware_protocol.usb.usbip import UsbipError
from firmware_protocol.usb.usbip_parser import HostParser, Reply
from transports.usb.host import PeerBroken, PeerGone

__all__ = ["Wire", "connect"]

_RECEIVE_BYTES = 256 << 10


def connect(host: str, port: int, timeout_s: float) -> socket.socket:
    """Return a socket to a server; raises PeerGone."""
    try:
        return socket.create_connection((host, port), timeout_s)
    except OSError as error:
        raise PeerGone(f"no USB/IP server at {host}:{port} ({error}); is the emulator running?") from error


class Wire:
    """A socket and the parser of what comes from it."""

    def __init__(self, sock: socket.socket) -> None:
        self.parser = HostParser()
        self._sock = sock
        self._chunk = memoryview(bytearray(_RECEIVE_BYTES))
        if sock.family in (socket.AF_INET, socket.AF_INET6):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, data: bytes) -> None:
        """Send a request; raises PeerGone."""
        # Requests are small and few are in flight: a server that takes none for so long is gone.
        self._sock.settimeout(10.0)
        try:
            self._sock.sendall(data)
        except OSError as error:
            raise PeerGone(f"the USB/IP server went away: {error}") from error

    def receive(self, deadline: float) -> Reply | None:
        """Return the next reply; None when none is complete by `deadline` (monotonic seconds).

        Raises PeerGone, PeerBroken.
        """
        while (reply := self._parse()) is None:
            if not self._fill(deadline):
                return None
        return reply

    def close(self) -> None:
        """Hang up."""
        self._sock.close()

    def _parse(self) -> Reply | None:
        try:
            return self.parser.next_message()
        except UsbipError as error:
            raise PeerBroken(f"the USB/IP server breaks the protocol: {error}") from error

    def _fill(self, deadline: float) -> bool:
        # Once more after the deadline, without waiting: what has arrived counts.
        self._sock.settimeout(max(0.0, deadline - time.monotonic()))
        try:
            n = self._sock.recv_into(self._chunk)
        except (TimeoutError, BlockingIOError):
            return False
        except OSError as error:
            raise PeerGone(f"the USB/IP server went away: {error}") from error
        if n == 0:
            raise PeerGone("the USB/IP server closed the connection")
        self.parser.receive(self._chunk[:n])
        return True
