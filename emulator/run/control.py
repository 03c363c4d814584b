"""Control socket of a running session, and the signal that it is ready.

`evstim fault` and `evstim trigger` send one line of JSON to the socket of a run, and receive one line:

    $XDG_RUNTIME_DIR/evstim/RIG-PID.sock        where there is no such directory: /tmp/evstim-UID/RIG-PID.sock

Only its owner can open it (directory 0700, socket 0600). The session polls it when it reports its status, ten times a
second, and never waits for a client: lines, clients and the work of one poll are bounded, and the oldest connection is
closed for a newer one. Requests and answers:

{"request": "faults"}                    ->  {"rig": ..., "pid": ..., "folder": where it was started, "t_s": ...,
                                             "links": {NAME: {"kinds": [...], "injected": []}}}
{"request": "inject", "fault": {table}}  ->  {"link": NAME, "after": number of its faults so far} or {"error": ...}
{"request": "end", "link": NAME, "number": N}  ->  {"link": NAME, "kind": KIND} or {"error": ...}
{"request": "trigger", "kind": KIND}     ->  {"links": [NAME, ...]}   "link": NAME for one alone
                                          KIND: pulse, rising, falling at the camera's input; reset: its clock

The ready signal is a file for scripts, and sd_notify for a service manager:

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
from typing import TYPE_CHECKING, Any

from emulator.rig.kinds import convert_fault, faults_of
from emulator.rig.loading import Rig
from emulator.run.outcome import RunStatus
from emulator.tables.typed_table import TableError
from firmware_protocol.events import EdgeKind
from transports import Closing
from transports.link.loop import EndFault, Happen, InjectFault

if TYPE_CHECKING:
    from emulator.run.session import Session

_MOST_LINE_BYTES = 1 << 16
_MOST_ANSWER_BYTES = 1 << 20
_MOST_CLIENTS = 16
_MOST_ACCEPTED = 64  # in one poll
_BACKLOG = 128
_ANSWER_TIMEOUT_S = 10.0
_RETRY_S = 0.02

Message = dict[str, Any]


class NoAnswer(Exception):
    """No answer at a socket: the run has ended, or hangs."""


def runtime_directory() -> Path:
    """Return the folder of the sockets, made if need be; raises OSError when it is not the user's alone."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    path = Path(base) / "evstim" if base else Path(tempfile.gettempdir()) / f"evstim-{os.getuid()}"
    path.mkdir(mode=0o700, exist_ok=True)
    status = path.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o077:
        raise PermissionError(f"{path} must be a directory that is yours alone (chmod 700)")
    return path


def sockets() -> list[Path]:
    """Return the sockets of running sessions; remove those that ended runs left behind."""
    try:
        return [path for path in sorted(runtime_directory().glob("*.sock")) if not _removed(path)]
    except OSError:
        return []


def send_request(path: Path, message: Message) -> Message:
    """Send a request to a run and return its answer; raises NoAnswer."""
    line = json.dumps(message).encode() + b"\n"
    deadline = time.monotonic() + _ANSWER_TIMEOUT_S
    while True:
        try:
            return _answer_to(path, line)
        except (BrokenPipeError, ConnectionResetError, BlockingIOError) as error:
            # Too many other clients: the run has not read this line, so it can be sent again.
            if time.monotonic() > deadline:
                raise NoAnswer(f"the run at {path} does not answer: {error}") from error
            time.sleep(_RETRY_S)
        except (OSError, ValueError) as error:
            raise NoAnswer(f"the run at {path} does not answer: {error}") from error


def _answer_to(path: Path, line: bytes) -> Message:
    """Send a line once and return the answer; raises OSError, ValueError."""
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(_ANSWER_TIMEOUT_S)
        client.connect(str(path))
        client.sendall(line)
        return _parsed(client.makefile("rb").readline(_MOST_ANSWER_BYTES))


class ControlSocket(Closing):
    """The run's end of the socket. The constructor may raise OSError; `close` removes the socket."""

    def __init__(self, rig: str) -> None:
        sockets()
        self.path = runtime_directory() / f"{rig}-{os.getpid()}.sock"
        self._socket = socket.socket(socket.AF_UNIX)
        try:
            self._listen()
        except OSError:
            self._socket.close()
            raise
        self._clients: list[_Client] = []  # the oldest first

    def poll(self, answer: Callable[[Message], Message]) -> None:
        """Answer the requests that have come; return at once."""
        for client in self._clients:
            client.advance(answer)
        with suppress(OSError):  # no other client waits, or it has disconnected
            for _ in range(_MOST_ACCEPTED):
                client = _Client(self._socket.accept()[0])
                client.advance(answer)
                self._clients = [*(client for client in self._clients if not client.over), client]
                while len(self._clients) > _MOST_CLIENTS:
                    self._clients.pop(0).close()
        self._clients = [client for client in self._clients if not client.over]

    def close(self) -> None:
        """Disconnect all clients, and remove the socket."""
        for client in self._clients:
            client.close()
        self._clients.clear()
        self._socket.close()
        self.path.unlink(missing_ok=True)

    def _listen(self) -> None:
        """Listen, and only then take the name: a socket that refuses connections is that of an ended run."""
        unnamed = self.path.with_suffix(".new")
        unnamed.unlink(missing_ok=True)
        self._socket.bind(str(unnamed))
        unnamed.chmod(0o600)
        self._socket.listen(_BACKLOG)
        self._socket.setblocking(False)
        unnamed.rename(self.path)


@dataclass
class _Client:
    """One connection: the part of its line that has come, then the part of its answer that is still to be sent."""

    socket: socket.socket
    line: bytes = b""
    answer: bytes = b""
    over: bool = False

    def __post_init__(self) -> None:
        self.socket.setblocking(False)

    def advance(self, answer: Callable[[Message], Message]) -> None:
        """Read and answer as far as possible without waiting."""
        try:
            if not self.answer and self._receive():
                self.answer = json.dumps(_answered(self.line, answer)).encode()[:_MOST_ANSWER_BYTES] + b"\n"
            if self.answer:
                self.answer = self.answer[self.socket.send(self.answer) :]
                self.over = not self.answer
        except BlockingIOError:
            return
        except OSError:  # it has disconnected
            self.over = True
        if self.over:
            self.close()

    def close(self) -> None:
        self.over = True
        self.socket.close()

    def _receive(self) -> bool:
        """Read on; return whether the line is complete, or too long."""
        data = self.socket.recv(_MOST_LINE_BYTES + 1 - len(self.line))
        self.line += data
        self.over = not data
        return b"\n" in data or len(self.line) > _MOST_LINE_BYTES


def _removed(path: Path) -> bool:
    """Remove a socket on which no run listens any more; return whether it is removed."""
    with socket.socket(socket.AF_UNIX) as client:
        client.setblocking(False)
        try:
            client.connect(str(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return True
        except FileNotFoundError:
            return True
        except OSError:  # its run is too busy to accept
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


def _parsed(line: bytes) -> Message:
    """Return a line as a JSON object; raises ValueError."""
    try:
        message = json.loads(line)
    except RecursionError as error:
        raise ValueError("the JSON is nested too deeply") from error
    if not isinstance(message, dict):
        raise ValueError("a JSON object is expected")
    return message


_EDGES = {"pulse": EdgeKind.PULSE, "rising": EdgeKind.RISING, "falling": EdgeKind.FALLING, "reset": None}


class FaultInjection:
    """Answers to the requests for one run, which its record names `by`; without a socket it does nothing.

    `trouble` is the reason why there is no socket; "" where there is one, or none is needed.
    """

    def __init__(
        self, rig: Rig, session: Session, socket: ControlSocket | None, trouble: str = "", by: str = "evstim"
    ) -> None:
        self._rig = rig
        self._session = session
        self._socket = socket
        self.trouble = trouble
        self._by = by

    def serve(self, status: RunStatus) -> None:
        """Answer the requests that have come since the last call."""
        if self._socket is not None:
            self._socket.poll(lambda message: self.answer(message, status))

    def answer(self, message: Message, status: RunStatus) -> Message:
        """Return the answer to one request."""
        match message:
            case {"request": "faults"}:
                return self._faults(status)
            case {"request": "inject", "fault": table}:
                return self._inject(table, status)
            case {"request": "end", "link": str(link), "number": int(number)}:
                return self._end(link, number, status)
            case {"request": "trigger", "kind": str(kind)}:
                return self._trigger(kind, message.get("link"))
        requests = "'faults', 'inject' with a fault, 'end' with a link and number, 'trigger' with a kind"
        return {"error": f"known requests: {requests}"}

    def _faults(self, status: RunStatus) -> Message:
        links: dict[str, Any] = {}
        for link in self._rig.links:
            report = status.links.get(link.name)
            injected = [] if report is None else [dataclasses.asdict(record) for record in report.faults]
            links[link.name] = {"kinds": list(faults_of(link)), "injected": injected}
            links[link.name]["state"] = "" if report is None else report.state
        origin = {"rig": self._rig.name, "pid": os.getpid(), "folder": os.getcwd()}
        return {**origin, "t_s": status.sim_seconds, "links": links}

    def _inject(self, table: object, status: RunStatus) -> Message:
        try:
            fault = convert_fault(table, self._rig.links, ())
        except TableError as error:
            at = ".".join(str(part) for part in error.path)
            return {"error": f"{at}: {error}" if at else str(error)}
        report = status.links.get(fault.link)
        self._session.order(fault.link, InjectFault(fault, self._by))
        return {"link": fault.link, "after": 0 if report is None else len(report.faults)}

    def _end(self, link: str, number: int, status: RunStatus) -> Message:
        report = status.links.get(link)
        records = () if report is None else report.faults
        record = next((fault for fault in records if fault.number == number), None)
        if record is None:
            return {"error": f"there is no fault {number} on link {link!r}"}
        if record.ended_us is not None:
            return {"error": f"{record.kind} on {link} is over since {record.ended_us / 1e6:.3f} s"}
        self._session.order(link, EndFault(number, self._by))
        return {"link": link, "kind": record.kind}

    def _trigger(self, kind: str, link: object) -> Message:
        if kind not in _EDGES:
            return {"error": f"kind {kind!r}: known are {', '.join(_EDGES)}"}
        present = [camera_link.name for camera_link in self._rig.links]
        names = [name for name in present if link in (None, name)]
        if not names:
            return {"error": f"link {link!r}: there is {', '.join(present)}"}
        for name in names:
            self._session.order(name, Happen(_EDGES[kind], self._by))
        return {"links": names}


@contextmanager
def fault_injection(rig: Rig, session: Session) -> Iterator[FaultInjection]:
    """Open the socket of a run that has links; if that fails, `trouble` contains the reason and the run goes on."""
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
    """Signal that a run is ready, sent once, at the first call of `send`; `path` is its file, None for none."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._sent = False

    def send(self, addresses: Mapping[str, str | None]) -> None:
        """Report that every link is open, at these addresses; raises OSError when the file cannot be written."""
        if self._sent:
            return
        self._sent = True
        if self._path is not None:
            part = self._path.with_name(self._path.name + ".part")
            part.write_text(json.dumps({"pid": os.getpid(), "links": dict(addresses)}) + "\n", encoding="utf-8")
            part.replace(self._path)
        if address := os.environ.get("NOTIFY_SOCKET"):
            with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as service_manager:
                service_manager.connect("\0" + address[1:] if address.startswith("@") else address)
                service_manager.send(b"READY=1")
