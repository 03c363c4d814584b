"""Serial ports that never wait.

    Port.write   takes what there is room for and says how much that was
    Port.read    gives what has come
    Port.heard   whether anybody is at the other side, where that can be known

pyserial's own `write` with a timeout of 0 spins for ever on a full port (pyserial 3.5, serialposix.py: EAGAIN is
swallowed and the loop has no other end), so ports with a file descriptor are written without it. The others
(rfc2217://, loop://) block in `write`; a thread of their own does that for them.
"""

from __future__ import annotations

import fcntl
import os
import queue
import select
import socket
import sys
import termios
import threading
from abc import ABC, abstractmethod
from contextlib import suppress

import serial

__all__ = ["Descriptor", "DescriptorPort", "Port", "ThreadedPort", "count_of"]

_READ_BYTES = 4096
_THREAD_BYTES = 4096  # what may wait for a port that blocks: as much as a kernel's transmit buffer


class Port(ABC):
    """An open serial port. Its methods return at once; they raise OSError when the port is gone."""

    @abstractmethod
    def write(self, data: bytes) -> int:
        """Take as many bytes from the front of `data` as there is room for; return how many that were."""

    @abstractmethod
    def read(self) -> bytes:
        """Return what has come, b"" when nothing has."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the port."""

    @property
    def heard(self) -> bool:
        """False when it is certain that nobody is at the other side."""
        return True

    @property
    def unsent(self) -> int:
        """Bytes that were taken and still wait inside this machine."""
        return 0

    @property
    @abstractmethod
    def address(self) -> str:
        """Where the other side finds it."""


class Descriptor:
    """Non-blocking bytes on a file descriptor."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        os.set_blocking(fd, False)

    def write(self, data: bytes) -> int:
        """Take as many bytes as there is room for."""
        try:
            return os.write(self.fd, data)
        except BlockingIOError:
            return 0

    def read(self) -> bytes:
        """Return what has come."""
        try:
            return os.read(self.fd, _READ_BYTES)
        except BlockingIOError:
            return b""

    def events(self) -> int:
        """Return what poll says of it."""
        poll = select.poll()
        poll.register(self.fd, select.POLLIN)
        return dict(poll.poll(0)).get(self.fd, 0)


def count_of(fd: int, request: int) -> int:
    """Return the number that an ioctl such as FIONREAD tells."""
    return int.from_bytes(fcntl.ioctl(fd, request, bytes(4)), sys.byteorder)


class DescriptorPort(Port):
    """A port of pyserial that has a file descriptor: a device, a socket."""

    def __init__(self, opened: serial.SerialBase) -> None:
        self._serial = opened
        self._side = Descriptor(opened.fileno())

    @property
    def address(self) -> str:
        """The device or URL."""
        return str(self._serial.port)

    def write(self, data: bytes) -> int:
        """See `Port.write`."""
        return self._side.write(data)

    def read(self) -> bytes:
        """See `Port.read`."""
        events = self._side.events()
        if not events:
            return b""
        data = self._side.read()
        if not data and events & (select.POLLIN | select.POLLHUP | select.POLLERR):
            raise ConnectionResetError(f"{self.address} has hung up")
        return data

    @property
    def unsent(self) -> int:
        """Bytes in the kernel's transmit buffer; 0 where there is none to ask."""
        with suppress(OSError):
            return count_of(self._side.fd, termios.TIOCOUTQ)
        return 0

    def close(self) -> None:
        """Close it; takes a third of a second for a socket."""
        # pyserial forgets to close a socket whose other side is gone (protocol_socket.py: shutdown raises first).
        connection: socket.socket | None = getattr(self._serial, "_socket", None)
        self._serial.close()
        if connection is not None:
            connection.close()


class ThreadedPort(Port):
    """A port of pyserial whose `write` blocks, with a thread that waits for it."""

    def __init__(self, opened: serial.SerialBase) -> None:
        self._serial = opened
        self._pieces: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._waiting = 0
        self._lock = threading.Lock()
        self._error: OSError | None = None
        self._thread = threading.Thread(target=self._write_all, daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """The URL."""
        return str(self._serial.port)

    def write(self, data: bytes) -> int:
        """See `Port.write`; a failure of earlier bytes is raised here."""
        if self._error is not None:
            raise self._error
        piece = data[: max(0, _THREAD_BYTES - self._waiting)]
        with self._lock:
            self._waiting += len(piece)
        self._pieces.put(piece)
        return len(piece)

    def read(self) -> bytes:
        """See `Port.read`."""
        data: bytes = self._serial.read(_READ_BYTES)
        return data

    @property
    def unsent(self) -> int:
        """Bytes that its thread has not written yet."""
        return 0 if self._error else self._waiting

    def close(self) -> None:
        """Close it; what its thread still holds is lost."""
        self._pieces.put(None)
        self._serial.close()
        self._thread.join(1.0)

    def _write_all(self) -> None:
        while (piece := self._pieces.get()) is not None:
            try:
                self._serial.write(piece)
            except OSError as error:
                self._error = error
                return
            with self._lock:
                self._waiting -= len(piece)
