"""Serial ports that never wait: what pyserial opens, and a pty pair of our own.

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
import sys
import termios
import threading
import tty
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import serial
from serial.rs485 import RS485Settings

from transports.serial_line.parameters import SerialParameters

__all__ = ["DescriptorPort", "Port", "PtyPort", "ThreadedPort", "open_port"]

_READ_BYTES = 4096
_THREAD_BYTES = 4096  # what may wait for a port that blocks: as much as a kernel's transmit buffer
_STOP_BITS = {1.0: serial.STOPBITS_ONE, 1.5: serial.STOPBITS_ONE_POINT_FIVE, 2.0: serial.STOPBITS_TWO}


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


class _Descriptor:
    """Non-blocking bytes on a file descriptor."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        os.set_blocking(fd, False)

    def write(self, data: bytes) -> int:
        try:
            return os.write(self.fd, data)
        except BlockingIOError:
            return 0

    def read(self) -> bytes:
        try:
            return os.read(self.fd, _READ_BYTES)
        except BlockingIOError:
            return b""

    def events(self) -> int:
        """Return what poll says of it."""
        poll = select.poll()
        poll.register(self.fd, select.POLLIN)
        return dict(poll.poll(0)).get(self.fd, 0)


@contextmanager
def _opened(path: str) -> Iterator[int]:
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        yield fd
    finally:
        os.close(fd)


def _count(fd: int, request: int) -> int:
    """Return the number that an ioctl such as FIONREAD tells."""
    return int.from_bytes(fcntl.ioctl(fd, request, bytes(4)), sys.byteorder)


class PtyPort(Port):
    """A pty pair: we hold one side, the other is a path that a reader opens like any serial port.

    It models no modem lines, no parity, no break, and the kernel ignores its baud rate. What a reader left unread when
    it closed the path is gone, as on a wire.
    """

    def __init__(self, symlink: str = "") -> None:
        master, other = os.openpty()
        tty.setraw(other)
        self._path = os.ttyname(other)
        os.close(other)  # so that poll tells whether a reader has it open
        self._side = _Descriptor(master)
        self._link = Path(symlink) if symlink else None
        self._was_heard = False
        if self._link:
            _point(self._link, self._path)

    @property
    def address(self) -> str:
        """Path of the other side."""
        return str(self._link or self._path)

    @property
    def heard(self) -> bool:
        """True while a reader has the other side open."""
        heard = not self._side.events() & select.POLLHUP
        if self._was_heard and not heard:
            self._forget()
        self._was_heard = heard
        return heard

    def write(self, data: bytes) -> int:
        """See `Port.write`."""
        return self._side.write(data)

    def read(self) -> bytes:
        """See `Port.read`; b"" also while no reader is there, when the kernel says EIO."""
        return self._side.read() if self._was_heard else b""

    def close(self) -> None:
        """Close our side; a reader sees its port hang up."""
        os.close(self._side.fd)
        if self._link and self._link.is_symlink() and os.readlink(self._link) == self._path:
            self._link.unlink()

    @property
    def unsent(self) -> int:
        """Bytes that the reader has not taken yet; 0 where it keeps the path to itself."""
        with suppress(OSError), _opened(self._path) as other:
            return _count(other, termios.FIONREAD)
        return 0

    def _forget(self) -> None:
        """Empty the kernel's buffers, so that the next reader does not get the last one's bytes."""
        with suppress(OSError, termios.error), _opened(self._path) as other:
            termios.tcflush(other, termios.TCIOFLUSH)


class DescriptorPort(Port):
    """A port of pyserial that has a file descriptor: a device, a socket."""

    def __init__(self, opened: serial.SerialBase) -> None:
        self._serial = opened
        self._side = _Descriptor(opened.fileno())

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
            return _count(self._side.fd, termios.TIOCOUTQ)
        return 0

    def close(self) -> None:
        """Close it."""
        self._serial.close()


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


def open_port(line: SerialParameters) -> Port:
    """Open a port; blocks while a network port connects.

    Raises
    ------
    OSError
        It cannot be had; the message says why and what to do.
    """
    if line.port == "pty":
        return PtyPort(line.symlink)
    try:
        opened = _open(line)
    except (OSError, ValueError, termios.error) as error:
        raise OSError(_advice(line.port, error)) from error
    with suppress(OSError):
        opened.fileno()
        return DescriptorPort(opened)
    return ThreadedPort(opened)


def _open(line: SerialParameters) -> serial.SerialBase:
    """Open and set up by pyserial; raises OSError, ValueError or termios.error."""
    opened = serial.serial_for_url(line.port, do_not_open=True)
    opened.baudrate = line.baud
    opened.bytesize, opened.parity, opened.stopbits = line.data_bits, line.parity[0].upper(), _STOP_BITS[line.stop_bits]
    opened.rtscts = line.flow == "rts_cts"
    opened.timeout = 0
    opened.write_timeout = None
    if "://" not in line.port:
        opened.exclusive = True
    opened.open()
    if line.rs485:
        opened.rs485_mode = RS485Settings()
    if line.break_ms:
        opened.send_break(line.break_ms * 1e-3)
    return opened


def _advice(port: str, error: Exception) -> str:
    """Say what to do about a port that does not open."""
    text = str(error)
    if isinstance(error, PermissionError) or "Permission denied" in text:
        cure = f"join the group that owns it (ls -l {port}; usually: sudo usermod -aG dialout $USER) and log in again"
    elif isinstance(error, FileNotFoundError) or "No such file" in text:
        cure = "is it plugged in? `python -m serial.tools.list_ports` lists what there is"
    elif "lock" in text or "busy" in text:
        cure = f"another program has it; `fuser -v {port}` tells which"
    elif "Connection refused" in text or "timed out" in text or "Name or service" in text:
        cure = "start what listens there first, and check host and port"
    elif "Invalid argument" in text or "not supported" in text:
        cure = "the port cannot do these settings (a pty has no parity): leave parity, stop_bits, rs485 at the default"
    else:
        cure = "check the port's name and its settings"
    return f"cannot open {port}: {text}; {cure}"


def _point(link: Path, target: str) -> None:
    """Make or renew a symbolic link; raises OSError rather than replace what is no link."""
    if link.is_symlink():
        link.unlink()
    try:
        link.symlink_to(target)
    except OSError as error:
        cure = "give a path that is free, in a folder that exists"
        raise OSError(f"symlink = {str(link)!r}: {error.strerror}; {cure}") from error
