"""Deliveries of a link during a run: the pipe from the link's process to the program that reads them.

link process: ForwardingRecorder --> pipe --> reading_deliveries, in a thread of this process --> `receive`
"""

from __future__ import annotations

import dataclasses
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from firmware_protocol.events import Edges, Events, empty_edges, empty_events
from firmware_protocol.recordings.part import IMU, Frame, ImuRecords, Part
from transports.link.process import LinkSetup
from transports.recording.part import PipeReader, Restart

_READ_BYTES = 1 << 20


@dataclass(frozen=True)
class Delivery:
    """Items that left a camera together on one link, in the time of the camera's clock.

    Attributes
    ----------
    events
        (n,) EVENT, sorted by t, us; read-only, as all arrays here.
    edges
        (m,) EDGE, triggers on the camera's external input, sorted by t, us.
    imu
        (k,) IMU, samples of the inertial unit, sorted by t, us.
    frames
        Frames of the active pixels, each with its times in us.
    restarted
        True when the camera's clock was set to zero before this delivery: for the first one, and after each timestamp
        reset.
    """

    events: Events = field(default_factory=empty_events)
    edges: Edges = field(default_factory=empty_edges)
    imu: ImuRecords = field(default_factory=lambda: np.zeros(0, IMU))
    frames: tuple[Frame, ...] = ()
    restarted: bool = False

    @property
    def nbytes(self) -> int:
        """Size of all arrays, bytes."""
        arrays = (self.events, self.edges, self.imu, *(frame.pixels for frame in self.frames))
        return sum(array.nbytes for array in arrays)


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
        yield [dataclasses.replace(setup, deliveries=writer) if setup.name == link else setup for setup in setups]
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
