"""Deliveries of a link during a run: the pipe from the link's process to the program that reads them.

link process: ForwardingRecorder --> pipe --> reading_deliveries, in a thread of this process --> `receive`
"""

from __future__ import annotations

import dataclasses
import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

from firmware_protocol.events import Kept
from firmware_protocol.recordings.part import Facts, Part, RecordingSummary, counts_of
from transports.link.deliveries import DeliveryRecorder, RecorderFactory
from transports.link.process import LinkSetup
from transports.recording.part import PipeReader, Restart, encoded_end, encoded_part, encoded_restart
from transports.recording.writer_process import PipeQueue

_READ_BYTES = 1 << 20
_CLOSE_S = 8.0  # a session waits 10 s for a link's last report


@dataclass(frozen=True, repr=False)
class Delivery(Kept, Part):
    """Items that left a camera together on one link, in the time of the camera's clock.

    Attributes
    ----------
    events : (n,) EVENT, sorted by t, us; read-only, as all arrays here.
    edges : (m,) EDGE, triggers on the camera's external input, sorted by t, us.
    imu : (k,) IMU, samples of the inertial unit, sorted by t, us.
    frames : frames of the active pixels, each with its times in us.
    restarted : True when the camera's clock was set to zero before this delivery: for the first one, and after each
        timestamp reset.
    """

    restarted: bool = False

    @property
    def nbytes(self) -> int:
        """Size of all arrays, bytes."""
        arrays = (self.events, self.edges, self.imu, *(frame.pixels for frame in self.frames))
        return sum(array.nbytes for array in arrays)


_FORWARDED_BYTES = 1 << 26


class ForwardingRecorder:
    """Sender of parts through a pipe, and to the recorder of the link's own file where there is one.

    In a run that is not paced `append` waits for room in the queue; in one that is, a part that finds none is left out,
    and counted in the message that ends the stream.

    Parameters
    ----------
    connection : writing end of the pipe; closed at the end.
    recorder : of the link's file; None: there is no file.
    """

    def __init__(self, connection: Connection, recorder: DeliveryRecorder | None) -> None:
        self._connection = connection
        self._recorder = recorder
        self._messages = PipeQueue(_FORWARDED_BYTES)
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
        """Reason for an incomplete file, for people; empty if it is complete or if there is none."""
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


@dataclass(frozen=True)
class _Forwarding:
    """Factory of a `ForwardingRecorder` in the link's process; one start of the link uses it up."""

    connection: Connection
    file: RecorderFactory | None

    def open(self, facts: Facts) -> ForwardingRecorder:
        """Return the recorder; raises OSError where the link's own file cannot be opened."""
        return ForwardingRecorder(self.connection, None if self.file is None else self.file.open(facts))

    def restarted(self, number: int) -> _Forwarding:
        """Return the factory itself: a run that reads deliveries does not start a link again."""
        return self


@contextmanager
def forwarding(
    setups: Sequence[LinkSetup[Any]], link: str, receive: Callable[[Delivery], None], missed: Callable[[int], None]
) -> Iterator[list[LinkSetup[Any]]]:
    """Return the links of a run, of which `link` sends what it delivers to `receive`, called in a thread.

    `missed` is called at the end with the number of events that the link could not send in time. At the end of the
    block the links have ended, and everything that they sent has been received.
    """
    reader, writer = Pipe(duplex=False)
    thread = threading.Thread(target=_receive_all, args=(reader, receive, missed), name=f"evstim deliveries of {link}")
    thread.start()
    try:
        yield [
            dataclasses.replace(setup, recorder=_Forwarding(writer, setup.recorder)) if setup.name == link else setup
            for setup in setups
        ]
    finally:
        writer.close()  # the link's process had a copy; the pipe ends now
        thread.join()


def _receive_all(reader: Connection, receive: Callable[[Delivery], None], missed: Callable[[int], None]) -> None:
    messages, restarted = PipeReader(), False
    with reader:
        while data := os.read(reader.fileno(), _READ_BYTES):
            for message in messages.feed(data):
                if isinstance(message, Restart):
                    restarted = True
                elif isinstance(message, Part):
                    receive(Delivery(message.events, message.edges, message.imu, message.frames, restarted))
                    restarted = False
                elif isinstance(message, dict):
                    missed(int(message["missing"].get("events", 0)))
