"""A running session's control socket: one line of JSON in, one line out, for `evstim fault` and the like.

    $XDG_RUNTIME_DIR/evstim/RIG-PID.sock        where there is no such directory: /tmp/evstim-UID/RIG-PID.sock

Only its owner can open it (directory 0700, socket 0600). The session looks at it when it reports its status, ten times
a second; nobody waits for a client that says nothing.
"""

from __future__ import annotations

import json
import os
import socket
import stat
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

__all__ = ["ControlSocket", "Message", "NoAnswer", "ask", "runtime_directory", "sockets"]

_MOST_BYTES = 1 << 20
_MOST_CLIENTS = 16
_ANSWER_TIMEOUT_S = 10.0

Message = dict[str, Any]


class NoAnswer(Exception):
    """Nobody answers at a socket: the run has ended, or hangs."""


def runtime_directory() -> Path:
    """Return where sockets are, made if need be; raises OSError when it is not ours alone."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    path = Path(base) / "evstim" if base else Path(tempfile.gettempdir()) / f"evstim-{os.getuid()}"
    path.mkdir(mode=0o700, exist_ok=True)
    found = path.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise PermissionError(f"{path} must be a directory that is yours alone (chmod 700)")
    return path


def sockets() -> list[Path]:
    """Return the sockets that are there, of runs that go on and of some that died."""
    try:
        return sorted(runtime_directory().glob("*.sock"))
    except OSError:
        return []


def ask(path: Path, message: Message) -> Message:
    """Say something to a run and return its answer; raises NoAnswer."""
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(_ANSWER_TIMEOUT_S)
        try:
            client.connect(str(path))
            client.sendall(json.dumps(message).encode() + b"\n")
            answer = client.makefile("rb").readline(_MOST_BYTES)
            return _parsed(answer)
        except (OSError, ValueError) as error:
            raise NoAnswer(f"the run at {path} does not answer: {error}") from error


class ControlSocket:
    """The run's end. Opening it raises OSError where that cannot be; closing it removes it."""

    def __init__(self, rig: str) -> None:
        self.path = runtime_directory() / f"{rig}-{os.getpid()}.sock"
        self.path.unlink(missing_ok=True)
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            self._socket.bind(str(self.path))
            self.path.chmod(0o600)
            self._socket.listen(_MOST_CLIENTS)
        except OSError:
            self._socket.close()
            raise
        self._socket.setblocking(False)
        self._clients: dict[socket.socket, bytes] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def poll(self, answer: Callable[[Message], Message]) -> None:
        """Answer what has been asked; returns at once."""
        with suppress(BlockingIOError):
            while len(self._clients) < _MOST_CLIENTS:
                client, _ = self._socket.accept()
                client.setblocking(False)
                self._clients[client] = b""
        for client in list(self._clients):
            self._hear(client, answer)

    def close(self) -> None:
        """Send off whoever is there, and remove the socket."""
        for client in self._clients:
            client.close()
        self._clients.clear()
        self._socket.close()
        self.path.unlink(missing_ok=True)

    def _hear(self, client: socket.socket, answer: Callable[[Message], Message]) -> None:
        try:
            data = client.recv(_MOST_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        line = self._clients[client] + data
        if data and b"\n" not in line and len(line) < _MOST_BYTES:
            self._clients[client] = line
            return
        del self._clients[client]
        with client, suppress(OSError):  # a client that has gone needs no answer
            if b"\n" in line:
                client.sendall(json.dumps(_answered(line, answer)).encode() + b"\n")


def _answered(line: bytes, answer: Callable[[Message], Message]) -> Message:
    try:
        return answer(_parsed(line.partition(b"\n")[0]))
    except ValueError as error:
        return {"error": str(error)}


def _parsed(line: bytes) -> Message:
    """Return a line as a JSON object; raises ValueError."""
    message = json.loads(line)
    if not isinstance(message, dict):
        raise ValueError("a JSON object is expected")
    return message
