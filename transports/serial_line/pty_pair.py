"""A pty pair of our own: the port of a machine that has none."""

from __future__ import annotations

import os
import select
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from transports.serial_line.port import Descriptor, Port, count_of
from transports.serial_line.pty_symlink import PtySymlink

__all__ = ["PtyPort"]


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
        self._side = Descriptor(master)
        self._was_heard = False
        try:
            self._link = PtySymlink(Path(symlink), self._path) if symlink else None
        except OSError:
            os.close(master)
            raise
        self._address = symlink or self._path

    @property
    def address(self) -> str:
        """Path of the other side."""
        return self._address

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
        if self._link is not None:
            self._link.close()
        os.close(self._side.fd)

    @property
    def unsent(self) -> int:
        """Bytes that the reader has not taken yet; 0 where it keeps the path to itself."""
        with suppress(OSError), _opened(self._path) as other:
            return count_of(other, termios.FIONREAD)
        return 0

    def _forget(self) -> None:
        """Empty the kernel's buffers, so that the next reader does not get the last one's bytes."""
        with suppress(OSError, termios.error), _opened(self._path) as other:
            termios.tcflush(other, termios.TCIOFLUSH)


@contextmanager
def _opened(path: str) -> Iterator[int]:
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        yield fd
    finally:
        os.close(fd)
