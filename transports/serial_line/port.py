"""Serial ports without blocking calls, and a reader of a serial line.

    Port.write        accepts the bytes for which there is room and returns their number
    Port.read         returns the received bytes
    Port.has_reader   False if it is certain that there is no reader at the other side

pyserial's own `write` with a timeout of 0 loops for ever on a full port (pyserial 3.5, serialposix.py: EAGAIN is
ignored and the loop has no other end), so ports with a file descriptor are written without it. The others (rfc2217://,
loop://) block in `write`; a separate thread does that for them.

`PtyPort` is a pty pair, for a machine without a serial port. `PtySymlink` is the symbolic link to it.

A killed process leaves its link behind, and the kernel gives the number of its pty to the next terminal that is opened:
the link may then lead to a terminal of another program. So the target of the link does not show if it is in use. Each
process that makes a link holds a Unix socket in the kernel's abstract name space, named after the path. The kernel
frees that name with the process, for any end of it, and no file is left.

`open_port` opens a port, or raises an error with the remedy. `listen_serial` reads an instrument until it is stopped or
the line is lost, and may send telecommands.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import queue
import select
import socket
import sys
import termios
import threading
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import serial
from serial.rs485 import RS485Settings

from firmware_protocol.packets.telecommands import Telecommand
from transports.link.pacing import Clock
from transports.reception import InstrumentReception, Receiving, receive
from transports.recording.record import Recorder
from transports.serial_line.kind import SerialLink

_READ_BYTES = 4096
_THREAD_BYTES = 4096  # limit of the bytes that wait for a blocking port: the size of a kernel's transmit buffer


class Port(ABC):
    """Open serial port. Its methods return at once; they raise OSError when the port is lost.

    `address` is where the other side finds it, `descriptor` becomes readable when bytes arrive; None: there is none.
    """

    address: str
    descriptor: int | None = None

    @abstractmethod
    def write(self, data: bytes) -> int:
        """Accept as many bytes from the front of `data` as there is room for; return their number."""

    @abstractmethod
    def read(self) -> bytes:
        """Return the received bytes, b"" if there are none."""

    @abstractmethod
    def close(self) -> None:
        """Close the port."""

    @property
    def has_reader(self) -> bool:
        """False when it is certain that there is no reader at the other side."""
        return True

    @property
    def unsent(self) -> int:
        """Number of accepted bytes that still wait inside this machine."""
        return 0


class _NonBlockingPort(Port):
    """Port with non-blocking input and output on a file descriptor."""

    def __init__(self, fd: int) -> None:
        self._fd = self.descriptor = fd
        os.set_blocking(fd, False)

    def write(self, data: bytes) -> int:
        """Accept as many bytes as there is room for."""
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0

    def read(self) -> bytes:
        """Return the received bytes."""
        try:
            return os.read(self._fd, _READ_BYTES)
        except BlockingIOError:
            return b""

    def _events(self) -> int:
        """Return the events that poll reports."""
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        return dict(poll.poll(0)).get(self._fd, 0)


def count_of(fd: int, request: int) -> int:
    """Return the number that an ioctl such as FIONREAD reports."""
    return int.from_bytes(fcntl.ioctl(fd, request, bytes(4)), sys.byteorder)


class DescriptorPort(_NonBlockingPort):
    """Port of pyserial that has a file descriptor: a device, a socket."""

    def __init__(self, opened: serial.SerialBase) -> None:
        self._serial = opened
        self.address = str(opened.port)
        super().__init__(opened.fileno())

    def read(self) -> bytes:
        """Return the received bytes."""
        events = self._events()
        if not events:
            return b""
        data = super().read()
        if not data and events & (select.POLLIN | select.POLLHUP | select.POLLERR):
            raise ConnectionResetError(f"{self.address} has hung up")
        return data

    @property
    def unsent(self) -> int:
        """Number of bytes in the kernel's transmit buffer; 0 if there is no such buffer."""
        with suppress(OSError):
            return count_of(self._fd, termios.TIOCOUTQ)
        return 0

    def close(self) -> None:
        """Close the port; takes a third of a second for a socket."""
        # pyserial does not close a socket whose other side is lost (protocol_socket.py: shutdown raises first).
        connection: socket.socket | None = getattr(self._serial, "_socket", None)
        self._serial.close()
        if connection is not None:
            connection.close()


class ThreadedPort(Port):
    """Port of pyserial whose `write` blocks, with a thread that makes the blocking calls."""

    def __init__(self, opened: serial.SerialBase) -> None:
        self._serial = opened
        self.address = str(opened.port)
        self._pieces: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._waiting = 0
        self._lock = threading.Lock()
        self._error: OSError | None = None
        self._thread = threading.Thread(target=self._write_all, daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> int:
        """Accept as many bytes as there is room for; a failure of earlier bytes is raised here."""
        if self._error is not None:
            raise self._error
        piece = data[: max(0, _THREAD_BYTES - self._waiting)]
        with self._lock:
            self._waiting += len(piece)
        self._pieces.put(piece)
        return len(piece)

    def read(self) -> bytes:
        """Return the received bytes."""
        return self._serial.read(_READ_BYTES)

    @property
    def unsent(self) -> int:
        """Number of bytes that its thread has not written yet."""
        return 0 if self._error else self._waiting

    def close(self) -> None:
        """Close the port; bytes that its thread still holds are lost."""
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


_MARK = "/./"  # in the target of each link that is made here, and in no usual one


class PtySymlink:
    """Symbolic link at `path` to the device `pty`, held until `close`; it replaces one of an ended process.

    Raises OSError if a running link, another link or file has this path, or the folder cannot be written.
    """

    def __init__(self, path: Path, pty: str) -> None:
        self._path, self._target = path, _MARK.join(os.path.split(pty))
        remove_abandoned(path)
        self._claim = _claimed(path)
        try:
            path.symlink_to(self._target)
        except OSError as error:
            self._claim.close()
            foreign = "it exists, and no link of this kind made it"
            raise OSError(_refusal(path, foreign if error.errno == errno.EEXIST else str(error.strerror))) from error

    def close(self) -> None:
        """Remove the link, unless another one has replaced it, and release the path."""
        if self._path.is_symlink() and os.readlink(self._path) == self._target:
            self._path.unlink()
        self._claim.close()


def remove_abandoned(path: Path) -> None:
    """Remove a link of a `PtySymlink` whose process has ended; that of a running one stays, and so does any other."""
    with suppress(OSError), _claimed(path):
        if (target := os.readlink(path)).startswith("/dev/") and _MARK in target:
            path.unlink()


def _claimed(path: Path) -> socket.socket:
    """Return the socket that stands for `path`; raises OSError while another process, or this one, has it."""
    place = os.path.join(os.path.realpath(path.parent), path.name)
    name = f"evstim-pty-{hashlib.sha256(os.fsencode(place)).hexdigest()}"
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        claim.bind(f"\0{name}")
    except OSError as error:
        claim.close()
        in_use = error.errno == errno.EADDRINUSE
        raise OSError(_refusal(path, "a running link has it" if in_use else str(error.strerror))) from error
    return claim


def _refusal(path: Path, reason: str) -> str:
    return f"symlink = {str(path)!r}: {reason}; give a path that is free, in a folder that exists"


class PtyPort(_NonBlockingPort):
    """Pty pair: one side is held here, the other is a path that a reader opens like any serial port.

    It has no modem lines, no parity and no break, and the kernel ignores its baud rate. Bytes that a reader left unread
    when it closed the path are lost, as on a wire.
    """

    def __init__(self, symlink: str = "") -> None:
        master, other = os.openpty()
        tty.setraw(other)
        self._path = os.ttyname(other)
        os.close(other)  # so that poll reports if a reader has it open
        super().__init__(master)
        self._had_reader = False
        try:
            self._link = PtySymlink(Path(symlink), self._path) if symlink else None
        except OSError:
            os.close(master)
            raise
        self.address = symlink or self._path

    @property
    def has_reader(self) -> bool:
        """True while a reader has the other side open."""
        present = not self._events() & select.POLLHUP
        if self._had_reader and not present:
            self._forget()
        self._had_reader = present
        return present

    def read(self) -> bytes:
        """Return the received bytes; b"" also while there is no reader, when the kernel returns EIO."""
        return super().read() if self._had_reader else b""

    def close(self) -> None:
        """Close our side; for a reader its port hangs up."""
        if self._link is not None:
            self._link.close()
        os.close(self._fd)

    @property
    def unsent(self) -> int:
        """Number of bytes that the reader has not read yet; 0 if it has locked the path."""
        with suppress(OSError), _opened(self._path) as other:
            return count_of(other, termios.FIONREAD)
        return 0

    def _forget(self) -> None:
        """Empty the kernel's buffers, so that the next reader does not get the earlier reader's bytes."""
        with suppress(OSError, termios.error), _opened(self._path) as other:
            termios.tcflush(other, termios.TCIOFLUSH)


@contextmanager
def _opened(path: str) -> Iterator[int]:
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        yield fd
    finally:
        os.close(fd)


_STOP_BITS = {1.0: serial.STOPBITS_ONE, 1.5: serial.STOPBITS_ONE_POINT_FIVE, 2.0: serial.STOPBITS_TWO}
_CURES = (
    (
        ("Permission denied",),
        "join the group that owns it (ls -l {port}; usually: sudo usermod -aG dialout $USER) and log in again",
    ),
    (("No such file",), "is it plugged in? `python -m serial.tools.list_ports` lists what there is"),
    (("lock", "busy"), "another program has it; `fuser -v {port}` shows which"),
    (
        ("Connection refused", "timed out", "Name or service"),
        "start what listens there first, and check host and port",
    ),
    (
        ("Invalid argument", "Inappropriate ioctl"),
        "the port cannot do these settings (no pty drives RS-485): leave rs485, parity, stop_bits at the default",
    ),
)
"""Remedies by the text of the error; pyserial wraps most errors, so that only their text is left."""


def open_port(line: SerialLink) -> Port:
    """Open a port; blocks while a network port connects. Raises OSError with the reason and the remedy."""
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


def _open(line: SerialLink) -> serial.SerialBase:
    """Open and set up by pyserial; raises OSError, ValueError or termios.error."""
    opened = serial.serial_for_url(line.port, do_not_open=True)
    opened.baudrate = line.baud
    opened.bytesize = line.data_bits
    opened.parity = line.parity[0].upper()
    opened.stopbits = _STOP_BITS[line.stop_bits]
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
    """Return the error message with the remedy for a port that does not open."""
    text = str(error)
    cures = [cure for signs, cure in _CURES if any(sign in text for sign in signs)]
    cure = cures[0] if cures else "check the port's name and its settings"
    return f"cannot open {port}: {text}; {cure.format(port=port)}"


_LOOK_PERIOD_NS = 500_000


def listen_serial(
    line: SerialLink,
    goes_on: Callable[[InstrumentReception], bool],
    clock: Clock,
    recorder: Recorder | None = None,
    commands: Sequence[Telecommand] = (),
) -> InstrumentReception:
    """Open the port, send `commands`, and read while `goes_on`, called after each turn, returns True.

    Raises OSError when the port cannot be opened; the reception ends if it is lost later.
    """
    listening = Receiving(line.profile, clock, recorder)
    port = open_port(line)
    unsent = b"".join(listening.receiver.wrap(command) for command in commands)

    def turn() -> None:
        nonlocal unsent
        unsent = unsent[port.write(unsent) :] if unsent else b""
        listening.take(b"".join(iter(port.read, b"")))
        clock.sleep_until(clock.now_ns() + _LOOK_PERIOD_NS)

    with closing(port):
        gone = receive(lambda: listening.now, goes_on, turn, lost=OSError)
    return listening.finish(gone=gone)
