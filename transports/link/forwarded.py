"""Copy of what a link delivers, sent to the session's process, for a Python program that reads it during the run."""

from __future__ import annotations

import threading
from collections import Counter
from multiprocessing.connection import Connection

from transports.recording.live import AnyRecorder
from transports.recording.part import Part, counts_of, encoded_end, encoded_part, encoded_restart
from transports.recording.summary import RecordingSummary
from transports.recording.writer_process import PipeQueue

__all__ = ["ForwardingRecorder"]

_CAPACITY_BYTES = 1 << 26
_CLOSE_S = 8.0  # a session waits 10 s for a link's last report


class ForwardingRecorder:
    """Sends parts through a pipe, and to the recorder of the link's own file where there is one.

    In a run that is not paced `append` waits for room in the queue; in one that is, a part that finds none is left out,
    and counted in the message that ends the stream.

    Parameters
    ----------
    connection : writing end of the pipe; closed at the end.
    recorder : of the link's file; None: there is no file.
    """

    def __init__(self, connection: Connection, recorder: AnyRecorder | None) -> None:
        self._connection = connection
        self._recorder = recorder
        self._messages = PipeQueue(_CAPACITY_BYTES)
        self._restarted = False
        self._missing: Counter[str] = Counter()
        self._thread = threading.Thread(target=self._send_all, name="deliveries", daemon=True)
        self._thread.start()

    def append(self, part: Part, *, restarted: bool = False, unix_us: int | None = None) -> None:
        """Add a part in device time; see `LiveRecorder.append`."""
        if self._recorder is not None:
            self._recorder.append(part, restarted=restarted, unix_us=unix_us)
        self._restarted |= restarted
        start = encoded_restart(unix_us or 0) if self._restarted else []
        if self._messages.put([*start, *encoded_part(part)], wait=unix_us is None):
            self._restarted = False
        else:
            self._missing.update(counts_of(part))

    def reach(self, t_us: int) -> None:
        """Take note that no event earlier than `t_us` will come, for the file."""
        if self._recorder is not None:
            self._recorder.reach(t_us)

    @property
    def trouble(self) -> str:
        """Why the file is not whole, for people; empty where it is, or where there is none."""
        return "" if self._recorder is None else self._recorder.trouble

    @property
    def summary(self) -> RecordingSummary | None:
        """Contents of the file, once it is closed; None where there is none."""
        return None if self._recorder is None else self._recorder.summary

    def close(self) -> None:
        """Send what waits and the end of the stream, and close the file."""
        self._messages.put(encoded_end(missing=self._missing), wait=True)
        self._messages.end()
        if self._recorder is not None:
            self._recorder.close()
        self._thread.join(_CLOSE_S)

    def _send_all(self) -> None:
        self._messages.send_all(self._connection.fileno())
        self._messages.stop()
        self._connection.close()
