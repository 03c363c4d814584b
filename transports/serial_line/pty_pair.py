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


def _point(link: Path, target: str) -> None:
    """Make or renew a symbolic link; raises OSError rather than replace what is no link."""
    try:
        if link.is_symlink():
            link.unlink()
        link.symlink_to(target)
    except OSError as error:
        cure = "give a path that is free, in a folder that exists"
        raise OSError(f"symlink = {str(link)!r}: {error.strerror}; {cure}") from error
