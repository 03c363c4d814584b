"""Process that writes one file, so that no disk delays a camera.

    recorder --put--> queue --thread--> pipe --> writer process --> file

The queue is bounded. `put` waits for room, or refuses messages without room, which the recorder counts. The process:

    stdin   messages, until its end
    stdout  a line of JSON when the file is open, or cannot be opened; another one when it is closed

It ends with its input, so that the file is finished even if the process that feeds it is killed. Signals to the whole
group are for the session, which then ends the input.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from fcntl import F_SETPIPE_SZ, fcntl
from typing import Any, Protocol, TypeVar

from transports.guarded_reader import child_command
from transports.recording.format import reason

_PIPE_BYTES = 1 << 20
_WRITE_BYTES = 1 << 20


class PipeQueue:
    """Bounded queue of messages for a pipe.

    Parameters
    ----------
    capacity_bytes : size of the messages that may wait. A larger message is accepted by an empty queue.

    Attributes
    ----------
    waiting_bytes : size of those that wait now, or are being sent.
    broken : True when nothing can be sent any more.
    """

    def __init__(self, capacity_bytes: int) -> None:
        self._capacity_bytes = capacity_bytes
        self._waiting: deque[bytes] = deque()
        self._changed = threading.Condition()
        self._ended = False
        self.waiting_bytes = 0
        self.broken = False

    @property
    def room_bytes(self) -> int:
        """Size of the messages that `put` takes now."""
        return 0 if self.broken else max(0, self._capacity_bytes - self.waiting_bytes)

    def put(self, messages: Sequence[bytes], *, wait: bool) -> bool:
        """Queue messages, all or none; False where there is no room, or, with `wait`, where the pipe is broken."""
        size = sum(len(message) for message in messages)
        with self._changed:
            if wait:
                self._changed.wait_for(lambda: self.broken or self._has_room(size))
            if self.broken or not self._has_room(size):
                return False
            self._queue(messages)
        return True

    def _has_room(self, size: int) -> bool:
        return not self.waiting_bytes or size <= self.room_bytes

    def _queue(self, messages: Sequence[bytes]) -> None:
        self._waiting.extend(messages)
        self.waiting_bytes += sum(len(message) for message in messages)
        self._changed.notify_all()

    def end(self, last: Sequence[bytes] = ()) -> None:
        """Let `send_all` return when all has been sent, and `last` after it, with or without room."""
        with self._changed:
            self._queue(last)
            self._ended = True

    def stop(self) -> None:
        """Refuse every further message."""
        with self._changed:
            self.broken = True
            self._changed.notify_all()

    def send_all(self, descriptor: int) -> None:
        """Write messages as they come, until `end`, or until the far end of the pipe is closed."""
        try:
            while data := self._next():
                _write(descriptor, data)
                with self._changed:
                    self.waiting_bytes -= len(data)
                    self._changed.notify_all()
        except OSError:  # the reader has ended
            self.stop()

    def _next(self) -> bytes:
        """Return the next messages as one, small ones together."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._ended)
            messages, size = [], 0
            while self._waiting and size < _WRITE_BYTES:
                messages.append(self._waiting.popleft())
                size += len(messages[-1])
            return b"".join(messages)


def _write(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]


class WriterProcess:
    """Process that writes a file, and the queue of messages to it. Only the constructor raises OSError.

    Parameters
    ----------
    function : its main function, "module:name", which calls `serve_writer`.
    order : argument of that function, of JSON; `path` is the file.
    capacity_bytes : size of the messages that may wait.

    Attributes
    ----------
    pid : number of the process.
    report : its report at the end, {} before: "trouble" is the reason for an incomplete file, "" if it is complete.
    """

    def __init__(self, function: str, order: Mapping[str, Any], capacity_bytes: int) -> None:
        self.report: dict[str, Any] = {}
        self._queue = PipeQueue(capacity_bytes)
        # A separate session: a signal to the group of the run must not end it before its input ends.
        self._process = subprocess.Popen(
            child_command(function, order),
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        self.pid = self._process.pid
        with suppress(OSError):  # a smaller pipe serves too
            fcntl(self._process.stdin, F_SETPIPE_SZ, _PIPE_BYTES)  # type: ignore[arg-type]
        answer = self._read_line()
        if "opened" not in answer:
            self._close_pipes()
            ended = f"its writer ended (exit code {self._process.returncode})"
            raise OSError(answer.get("errno", 0), answer.get("error", ended), str(order["path"]))
        self._thread = threading.Thread(target=self._send_all, name="recording", daemon=True)
        self._thread.start()

    @property
    def broken(self) -> bool:
        """True if the process has ended, so that nothing more is written."""
        return self._queue.broken or self._process.poll() is not None

    @property
    def room_bytes(self) -> int:
        """Size of the messages that `put` accepts now."""
        return self._queue.room_bytes

    def put(self, messages: Sequence[bytes], *, wait: bool) -> bool:
        """Send messages, all or none; False where there is no room, or, with `wait`, where nothing is written."""
        return self._queue.put(messages, wait=wait)

    def close(self, within_s: float, last: Sequence[bytes] = ()) -> None:
        """Let it end the file after the `last` messages, receive its report; reports if it goes on after `within_s`."""
        self._queue.end(last)
        self._thread.join(within_s)
        if self._thread.is_alive():
            self.report = {"trouble": f"still being written by process {self.pid}"}

    def _send_all(self) -> None:
        """Send the waiting messages until the end, then read the report; runs in the thread."""
        self._queue.send_all(self._process.stdin.fileno())  # type: ignore[union-attr]
        with suppress(OSError):
            self._process.stdin.close()  # type: ignore[union-attr]
        self.report = self._read_line() or {"trouble": "its writer was killed"}
        self._queue.stop()
        self._close_pipes()

    def _close_pipes(self) -> None:
        """Wait for the process to end, and close the pipes."""
        with suppress(OSError):
            self._process.stdin.close()  # type: ignore[union-attr]
        self._process.stdout.close()  # type: ignore[union-attr]
        self._process.wait()

    def _read_line(self) -> dict[str, Any]:
        """Return the process's next line, {} if it ended without one."""
        line = self._process.stdout.readline() if self._process.stdout else b""
        try:
            answer: dict[str, Any] = json.loads(line)
        except ValueError:
            return {}
        return answer


class _File(Protocol):
    def close(self) -> None: ...


_F = TypeVar("_F", bound=_File)


def serve_writer(
    opened: Callable[[], _F], write: Callable[[_F], None], report: Callable[[_F], Mapping[str, Any]]
) -> None:
    """Run the writer: `write` writes stdin's messages to the file and closes it; `report` follows, or is first."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    try:
        file = opened()
    except BaseException as error:  # noqa: BLE001 a panic of Rust is no Exception
        # A library may name the operating system's error in the text of its own.
        match = re.search(r"errno = (\d+)|os error (\d+)", str(error))
        _report(error=reason(error), errno=getattr(error, "errno", None) or int(match[1] or match[2] if match else 0))
        return
    _report(opened=True)
    try:
        write(file)
    except BaseException as error:  # noqa: BLE001
        _report(trouble=reason(error), **report(file))
        with suppress(BaseException):  # HDF5 may crash in here, when the disk is full
            file.close()
    else:
        _report(trouble="", **report(file))


def _report(**values: Any) -> None:
    with suppress(OSError):  # no process reads it
        os.write(1, json.dumps(values).encode() + b"\n")
