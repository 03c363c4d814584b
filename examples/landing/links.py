"""The flight computer's two links: events from a serial line, attitudes and SYNCs from the CAN bus.

A line does not repeat lost data: the camera's housekeeping contains the number of sent events, and those that have not
come before a second report on the same line are lost. A port that disappears is opened again as soon as it is back.
"""

from __future__ import annotations

import math
import os
import select
import termios
import time
import tty
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import can
import numpy as np
from frames import ATTITUDE, COMMAND, EDGE, SYNC, pack_command, pack_edge, unpack_attitude
from window import Window

from evstim import SerialReceiver
from firmware_protocol.packets.housekeeping import Housekeeping
from firmware_protocol.packets.telecommands import RequestHousekeeping

__all__ = ["Arrival", "Edge", "Links"]

_REQUEST_S = 0.5
_PATIENCE_S = 10.0  # longest wait for missing events, wall time: the line is stalled
_STANDS_S = 5.0  # longest wait for a camera whose time stands still, wall time: it receives no SYNC


@dataclass(frozen=True)
class Edge:
    """A SYNC among the events: its time and its counter on the bus."""

    t_us: int
    counter: int


class Arrival(NamedTuple):
    """Some events that came at one instant: that of CLOCK_MONOTONIC, the oldest and the newest event, their number."""

    at_ns: int
    oldest_us: int
    newest_us: int
    events: int


class Links:
    """The two links, read in one thread without waiting for either.

    Parameters
    ----------
    port : path of the serial line.
    bus : the CAN bus.
    attitude_s : time of an attitude by its number.
    sensors : receives identifier and data of each frame, those of the vehicle's own sensors among them.
    """

    def __init__(
        self,
        port: str,
        bus: can.BusABC,
        attitude_s: Callable[[int], float],
        sensors: Callable[[int, bytes], None] = lambda identifier, data: None,
    ) -> None:
        self._path, self._bus, self._attitude_s, self._sensors = port, bus, attitude_s, sensors
        self._port: int | None = None
        self._receiver = SerialReceiver("ccsds-cobs")
        self._received = 0
        self.edges: list[Edge] = []
        self.arrivals: list[Arrival] = []
        self.syncs = self.lost = self.unplugged = 0
        self._open()

    @property
    def plugged(self) -> bool:
        """True while the serial line is open."""
        return self._port is not None

    def complete(self, window: Window, until_us: int = 0) -> None:
        """Read until every event that the camera had at the call, or had at `until_us`, has come or is lost.

        Returns at once without a serial line, after ten seconds where it is stalled, and after five where the camera
        answers but its time stands still.
        """
        end_s = time.monotonic() + _PATIENCE_S
        first = self._report(window, until_us, end_s)
        if first is None or self._received + self.lost >= first.events.sent:
            return
        requested_s = time.monotonic()
        while self.plugged and self._received + self.lost < first.events.sent and time.monotonic() < end_s:
            self.receive(window, 0.01)
            if time.monotonic() > requested_s + _REQUEST_S:
                if self._report(window, 0, end_s) is not None:
                    self.lost = max(self.lost, first.events.sent - self._received)
                requested_s = time.monotonic()

    def receive(self, window: Window, timeout_s: float) -> None:
        """Read the received data into the window."""
        if self._port is None and not self._open():
            time.sleep(timeout_s)
        elif self._port is not None:
            select.select([self._port], [], [], timeout_s)
            self._read_serial(window)
        while (message := self._bus.recv(0)) is not None:
            self.syncs += message.arbitration_id == SYNC
            self._sensors(message.arbitration_id, bytes(message.data))
            if message.arbitration_id == ATTITUDE:
                q, number = unpack_attitude(bytes(message.data))
                window.add_attitude(self._attitude_s(number), q)

    def send(self, command: np.ndarray, turn: int) -> None:
        """Send a command."""
        self._send(COMMAND, pack_command(command, turn))

    def send_frame(self, identifier: int, data: bytes) -> None:
        """Send a frame."""
        self._send(identifier, data)

    def send_edge(self, edge: Edge) -> None:
        """Send the time of a SYNC's edge."""
        self._send(EDGE, pack_edge(edge.counter, edge.t_us))

    def _send(self, identifier: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def _report(self, window: Window, until_us: int, end_s: float) -> Housekeeping | None:
        """Return the next report of the camera in which no event waits; None when none comes."""
        before, requested_s = self._receiver.housekeeping, 0.0
        newest_us, stands_s = -1, math.inf
        while self.plugged and time.monotonic() < min(end_s, stands_s):
            report = self._receiver.housekeeping
            if report is not None and report is not before and report.t_us > newest_us:
                newest_us, stands_s = report.t_us, time.monotonic() + _STANDS_S
            if report is not None and report is not before and not report.events.waiting and report.t_us >= until_us:
                return report
            if time.monotonic() > requested_s + _REQUEST_S or report is not before:
                self._request()
                before, requested_s = report, time.monotonic()
            self.receive(window, 0.01)
        return None

    def _request(self) -> None:
        if self._port is not None:
            try:
                os.write(self._port, self._receiver.wrap(RequestHousekeeping()))
            except OSError:
                self._unplug()

    def _open(self) -> bool:
        try:
            self._port = os.open(self._path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            tty.setraw(self._port, termios.TCSANOW)
        except (OSError, termios.error):
            self._unplug()
        return self.plugged

    def _unplug(self) -> None:
        if self._port is not None:
            os.close(self._port)
            self._port = None
            self.unplugged += 1

    def _read_serial(self, window: Window) -> None:
        assert self._port is not None
        try:
            while data := os.read(self._port, 1 << 16):
                self._receiver.push(data)
            self._unplug()  # a line without data raises; an end of file is a port that disappeared
        except BlockingIOError:
            pass
        except OSError:
            self._unplug()
        self._take(window)

    def _take(self, window: Window) -> None:
        events = self._receiver.take_events()
        if len(events):
            self._received += len(events)
            oldest_us, newest_us = int(events["t"][0]), int(events["t"][-1])
            self.arrivals.append(Arrival(time.monotonic_ns(), oldest_us, newest_us, len(events)))
            window.add_events(events)
        edges = self._receiver.take_edges()
        self.edges += [Edge(*one) for one in zip(edges["t"].tolist(), edges["seq"].tolist(), strict=True)]
