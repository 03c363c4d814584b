"""The symbolic link that leads to a pty, and whose it is.

A process that is killed leaves its link behind, and the kernel gives the number of its pty to the next terminal that is
opened: the link may then lead to a terminal of somebody else. Where it leads therefore does not show whether it is in
use. Each process that makes a link holds a Unix socket in the kernel's abstract name space, named after the path; the
kernel frees that name with the process, however this ends, and no file is left.
"""

from __future__ import annotations

import errno
import hashlib
import os
import socket
from contextlib import suppress
from pathlib import Path

__all__ = ["PtySymlink", "remove_abandoned"]

_DEVICES = "/dev/pts/"


class PtySymlink:
    """A symbolic link at `path` to `target`, held until `close`.

    Raises
    ------
    OSError
        A running link has this path, something that is no link lies there, or the folder cannot be written.
    """

    def __init__(self, path: Path, target: str) -> None:
        self._path, self._target = path, target
        self._claim = _claimed(path)
        try:
            if path.is_symlink():
                path.unlink()
            path.symlink_to(target)
        except OSError as error:
            self._claim.close()
            raise OSError(_refusal(path, error.strerror or str(error))) from error

    def close(self) -> None:
        """Remove the link, unless another one lies there now, and give up the path."""
        if self._path.is_symlink() and os.readlink(self._path) == self._target:
            self._path.unlink()
        self._claim.close()


def remove_abandoned(path: Path) -> None:
    """Remove a link to a pty whose process has ended; that of a running process stays, and so does any other file."""
    with suppress(OSError), _claimed(path):
        if path.is_symlink() and os.readlink(path).startswith(_DEVICES):
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


def _refusal(path: Path, why: str) -> str:
    return f"symlink = {str(path)!r}: {why}; give a path that is free, in a folder that exists"
