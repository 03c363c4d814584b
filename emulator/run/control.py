"""A running session's control socket: one line of JSON in, one line out, for `evstim fault` and the like.

    $XDG_RUNTIME_DIR/evstim/RIG-PID.sock        where there is no such directory: /tmp/evstim-UID/RIG-PID.sock

Only its owner can open it (directory 0700, socket 0600). The session looks at it when it reports its status, ten times
a second; nobody waits for a client that says nothing, reads nothing or never stops: lines, clients and the work of one
look are bounded, and the client that has been silent longest makes way for a newer one.

Faults and edges by hand: what a running session answers to `evstim fault` and `evstim trigger`.

{"ask": "faults"}                     ->  {"rig": ..., "t_s": ..., "links": {NAME: {"kinds": [...], "injected": [...]}}}
{"ask": "inject", "fault": {table}}   ->  {"link": NAME, "after": number of its faults so far} or {"error": ...}
{"ask": "trigger", "kind": KIND}      ->  {"links": [NAME, ...]}   "link": NAME for one alone
                                          KIND: pulse, rising, falling at the camera's input; reset: its clock

For one version more, "throw" is understood for "inject", and "injected" is there as "thrown" too.

Tell whoever started a run that it is ready: a file for scripts, sd_notify for a service manager.

file         one line of JSON, {"pid": ..., "links": {NAME: ADDRESS or null}}; it appears whole or not at all
sd_notify    READY=1 to the socket that $NOTIFY_SOCKET names (systemd.exec, Type=notify)
"""

from __future__ import annotations

import dataclasses
import json
import os
import socket
import stat
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self

from emulator.rig.kinds import convert_fault, faults_of
from emulator.rig.loading import Rig
from emulator.run.outcome import RunStatus
from emulator.tables.typed_table import TableError
from firmware_protocol.events import EdgeKind
from transports.faults.kinds import Fault

__all__ = [
    "ControlSocket",
    "FaultInjection",
    "Message",
    "NoAnswer",
    "ReadySignal",
    "ask",
    "fault_injection",
    "runtime_directory",
    "sockets",
]


_MOST_LINE_BYTES = 1 << 16
_MOST_ANSWER_BYTES = 1 << 20
_MOST_CLIENTS = 16
_MOST_ACCEPTED = 64  # in one look
_BACKLOG = 128
_ANSWER_TIMEOUT_S = 10.0
_RETRY_S = 0.02

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
    """Return the sockets of runs that go on; those that dead runs left behind are removed."""
    try:
        return [path for path in sorted(runtime_directory().glob("*.sock")) if not _removed(path)]
    except OSError:
        return []


def ask(path: Path, message: Message) -> Message:
    """Say something to a run and return its answer; raises NoAnswer."""
    line = json.dumps(message).encode() + b"\n"
    deadline = time.monotonic() + _ANSWER_TIMEOUT_S
    while True:
        try:
            return _asked(path, line)
        except (BrokenPipeError, ConnectionResetError, BlockingIOError) as error:
            # Too many others ask: nobody has read our line, so it can be said again.
            if time.monotonic() > deadline:
                raise NoAnswer(f"the run at {path} does not answer: {error}") from error
            time.sleep(_RETRY_S)
        except (OSError, ValueError) as error:
            raise NoAnswer(f"the run at {path} does not answer: {error}") from error


def _asked(path: Path, line: bytes) -> Message:
    """Say a line once and return the answer; raises OSError, ValueError."""
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(_ANSWER_TIMEOUT_S)
        client.connect(str(path))
        client.sendall(line)
        return _parsed(client.makefile("rb").readline(_MOST_ANSWER_BYTES))


class ControlSocket:
    """The run's end. Opening it raises OSError where that cannot be; closing it removes it."""

    def __init__(self, rig: str) -> None:
        sockets()
        self.path = runtime_directory() / f"{rig}-{os.getpid()}.sock"
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            self._listen()
        except OSError:
            self._socket.close()
            raise
        self._clients: list[_Client] = []  # the one that came first in front

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def poll(self, answer: Callable[[Message], Message]) -> None:
        """Answer what has been asked; returns at once."""
        for client in self._clients:
            client.advance(answer)
        with suppress(OSError):  # nobody else waits, or who waited has gone
            for _ in range(_MOST_ACCEPTED):
                client = _Client(self._socket.accept()[0])
                client.advance(answer)
                self._clients.append(client)
                self._make_way()
        self._clients = [client for client in self._clients if not client.over]

    def close(self) -> None:
        """Send off whoever is there, and remove the socket."""
        for client in self._clients:
            client.close()
        self._clients.clear()
        self._socket.close()
        self.path.unlink(missing_ok=True)

    def _listen(self) -> None:
        """Listen, and only then take the name: a socket that refuses connections is that of a dead run."""
        unnamed = self.path.with_suffix(".new")
        unnamed.unlink(missing_ok=True)
        self._socket.bind(str(unnamed))
        unnamed.chmod(0o600)
        self._socket.listen(_BACKLOG)
        self._socket.setblocking(False)
        unnamed.rename(self.path)

    def _make_way(self) -> None:
        self._clients = [client for client in self._clients if not client.over]
        while len(self._clients) > _MOST_CLIENTS:
            self._clients.pop(0).close()


@dataclass
class _Client:
    """One connection: what it has said of its line, then what it has not taken of its answer."""

    socket: socket.socket
    line: bytes = b""
    answer: bytes = b""
    over: bool = False

    def __post_init__(self) -> None:
        self.socket.setblocking(False)

    def advance(self, answer: Callable[[Message], Message]) -> None:
        """Do what can be done without waiting."""
        try:
            if not self.answer and self._hear():
                self.answer = _encoded(_answered(self.line, answer))
            if self.answer:
                self.answer = self.answer[self.socket.send(self.answer) :]
                self.over = not self.answer
        except BlockingIOError:
            return
        except OSError:  # it has gone
            self.over = True
        if self.over:
            self.close()

    def close(self) -> None:
        self.over = True
        self.socket.close()

    def _hear(self) -> bool:
        """Read on; say whether the line is complete. One that is too long is answered as far as it came."""
        data = self.socket.recv(_MOST_LINE_BYTES + 1 - len(self.line))
        self.line += data
        self.over = not data
        return b"\n" in data or len(self.line) > _MOST_LINE_BYTES


def _removed(path: Path) -> bool:
    """Remove a socket at which nobody listens any more; say whether that was so."""
    with socket.socket(socket.AF_UNIX) as client:
        client.setblocking(False)
        try:
            client.connect(str(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return True
        except FileNotFoundError:
            return True
        except OSError:  # it is too busy for us: somebody is there
            return False
    return False


def _answered(line: bytes, answer: Callable[[Message], Message]) -> Message:
    if len(line) > _MOST_LINE_BYTES:
        return {"error": f"a line has at most {_MOST_LINE_BYTES} bytes"}
    try:
        return answer(_parsed(line.partition(b"\n")[0]))
    except ValueError as error:
        return {"error": str(error)}
    except RecursionError:
        return {"error": "the JSON is nested too deeply"}


def _encoded(message: Message) -> bytes:
    return json.dumps(message).encode()[:_MOST_ANSWER_BYTES] + b"\n"


def _parsed(line: bytes) -> Message:
    """Return a line as a JSON object; raises ValueError."""
    try:
        message = json.loads(line)
    except RecursionError as error:
        raise ValueError("the JSON is nested too deeply") from error
    if not isinstance(message, dict):
        raise ValueError("a JSON object is expected")
    return message


_HAPPENINGS = {"pulse": EdgeKind.PULSE, "rising": EdgeKind.RISING, "falling": EdgeKind.FALLING, "reset": None}


class _Session(Protocol):
    def inject(self, fault: Fault) -> None:
        """Begin a fault on the link that it names."""

    def happen(self, link: str, kind: EdgeKind | None) -> None:
        """Let an edge come to the input of a link's camera, or its clock start anew."""


class FaultInjection:
    """Answers for one run; without a socket it does nothing.

    Attributes
    ----------
    trouble
        Why there is no socket; "" where there is one, or none is needed.
    """

    def __init__(self, rig: Rig, session: _Session, socket: ControlSocket | None, trouble: str = "") -> None:
        self._rig = rig
        self._session = session
        self._socket = socket
        self.trouble = trouble

    def serve(self, status: RunStatus) -> None:
        """Answer what has been asked since the last call."""
        if self._socket is not None:
            self._socket.poll(lambda message: self.answer(message, status))

    def answer(self, message: Message, status: RunStatus) -> Message:
        """Return the answer to one question."""
        match message:
            case {"ask": "faults"}:
                return self._faults(status)
            case {"ask": "inject" | "throw", "fault": table}:
                return self._inject(table, status)
            case {"ask": "trigger", "kind": str(kind)}:
                return self._trigger(kind, message.get("link"))
        return {"error": "known are ask = 'faults' and ask = 'inject' with a fault, ask = 'trigger' with a kind"}

    def _faults(self, status: RunStatus) -> Message:
        links: dict[str, Any] = {}
        for link in self._rig.links:
            report = status.links.get(link.name)
            injected = [] if report is None else [dataclasses.asdict(record) for record in report.faults]
            links[link.name] = {"kinds": list(faults_of(link)), "injected": injected, "thrown": injected}
            links[link.name]["state"] = "" if report is None else report.state
        return {"rig": self._rig.name, "t_s": status.sim_seconds, "links": links}

    def _inject(self, table: object, status: RunStatus) -> Message:
        try:
            fault = convert_fault(table, self._rig.links, ())
        except TableError as error:
            at = ".".join(str(part) for part in error.path)
            return {"error": f"{at}: {error}" if at else str(error)}
        report = status.links.get(fault.link)
        self._session.inject(fault)
        return {"link": fault.link, "after": 0 if report is None else len(report.faults)}

    def _trigger(self, kind: str, link: object) -> Message:
        if kind not in _HAPPENINGS:
            return {"error": f"kind {kind!r}: known are {', '.join(_HAPPENINGS)}"}
        names = [one.name for one in self._rig.links if link in (None, one.name)]
        if not names:
            return {"error": f"link {link!r}: there is {', '.join(one.name for one in self._rig.links)}"}
        for name in names:
            self._session.happen(name, _HAPPENINGS[kind])
        return {"links": names}


@contextmanager
def fault_injection(rig: Rig, session: _Session) -> Iterator[FaultInjection]:
    """Open the socket of a run that has links; if that fails, `trouble` tells why and the run goes on."""
    if not rig.links:
        yield FaultInjection(rig, session, None)
        return
    try:
        socket = ControlSocket(rig.name)
    except OSError as error:
        yield FaultInjection(rig, session, None, f"no control socket, so no `evstim fault` for this run: {error}")
        return
    with socket:
        yield FaultInjection(rig, session, socket)


class ReadySignal:
    """Tells once, at the first call of `tell`.

    Parameters
    ----------
    path : the file to write; None for none.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._told = False

    def tell(self, addresses: Mapping[str, str | None]) -> None:
        """Say that every link is open, at these addresses; raises OSError when the file cannot be written."""
        if self._told:
            return
        self._told = True
        if self._path is not None:
            part = self._path.with_name(self._path.name + ".part")
            part.write_text(json.dumps({"pid": os.getpid(), "links": dict(addresses)}) + "\n", encoding="utf-8")
            part.replace(self._path)
        _notify("READY=1")


def _notify(message: str) -> None:
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as service_manager:
        service_manager.connect("\0" + address[1:] if address.startswith("@") else address)
        service_manager.send(message.encode())
