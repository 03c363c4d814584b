"""Links of the spacecraft and of the flight computer, and faults outside the camera.

The spacecraft sends poses by UDP; attitudes, samples, SYNCs and commands go over the CAN bus; the flight computer
receives events from a serial line. A line does not repeat lost data: the camera's housekeeping contains the number of
sent events, and those that have not come before a second report on the same line are lost. A port that disappears is
opened again as soon as it is back. Faults of poses, of frames, and of the flight computer:

    KIND@AT[+FOR][=SHARE]      from stream time AT, s, for FOR seconds (to the end where left out)

    nan@12+3          poses whose place is not a number         refused and counted by evstim
    stop@12+3         no poses
    backwards@12+3    poses whose times run back from AT        refused as stale and counted by evstim
    lose@0=0.05       attitudes and commands are lost on the bus, each with this chance
    crash@12          the flight computer ends with an exception
    hang@12           the flight computer runs, and answers no more

Faults of the camera's links are evstim's own: tables of the rig, docs/faults.md.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import os
import re
import select
import socket
import struct
import termios
import time
import tty
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import can
import numpy as np
from divergence import Window
from frames import COMMAND, ESTIMATE, SYNC, unpack_command
from vehicle import State, Vector, product

from evstim import SerialReceiver
from firmware_protocol.packets.housekeeping import Housekeeping
from firmware_protocol.packets.telecommands import RequestHousekeeping
from firmware_protocol.pose_message import PoseMessage

KINDS = ("nan", "stop", "backwards", "lose", "crash", "hang")
_TEXT = re.compile(r"(?P<kind>[a-z]+)@(?P<at>[\d.]+)(\+(?P<for>[\d.]+))?(=(?P<share>[\d.]+))?")
_PLACE = 16  # of x in the datagram, docs/rigs.md


@dataclass(frozen=True)
class Fault:
    """One fault: kind, beginning and length in stream time, s, and chance for each where that matters."""

    kind: str
    at_s: float
    for_s: float = 1e9
    share: float = 1.0

    @classmethod
    def parse(cls, text: str) -> Fault:
        """Return the fault of a text as above; raises ValueError."""
        found = _TEXT.fullmatch(text)
        if found is None or found["kind"] not in KINDS:
            raise ValueError(f"{text!r}: a fault is KIND@AT[+FOR][=SHARE], KIND one of {', '.join(KINDS)}")
        return cls(found["kind"], float(found["at"]), float(found["for"] or 1e9), float(found["share"] or 1))

    def on(self, t_s: float) -> bool:
        """Return True while the fault lasts."""
        return self.at_s <= t_s < self.at_s + self.for_s


class Faults:
    """The faults of one flight, in any order; `seed` is that of the frames that are lost."""

    def __init__(self, faults: Sequence[Fault] = (), seed: int = 0) -> None:
        self._faults = tuple(faults)
        self._draw = np.random.default_rng([seed, 1])
        self.frames_lost = 0

    def datagram(self, message: PoseMessage, t_s: float) -> bytes | None:
        """Return what is sent in the place of a pose; None for nothing."""
        kinds = {fault.kind: fault for fault in self._faults if fault.on(t_s)}
        if "stop" in kinds:
            return None
        if "backwards" in kinds:
            t_ns = max(round((2 * kinds["backwards"].at_s - t_s) * 1e9), 0)
            message = dataclasses.replace(message, t_ns=t_ns)
        data = bytearray(bytes(message))
        if "nan" in kinds:
            struct.pack_into("<d", data, _PLACE, math.nan)
            struct.pack_into("<I", data, len(data) - 4, zlib.crc32(data[:-4]))
        return bytes(data)

    def loses_frame(self, t_s: float) -> bool:
        """Return whether the bus loses the next attitude, sample or command."""
        lost = any(one.kind == "lose" and one.on(t_s) and self._draw.random() < one.share for one in self._faults)
        self.frames_lost += lost
        return lost


@contextmanager
def opened_bus(port: int) -> Iterator[can.BusABC]:
    """Give the served bus of a TCP port of this machine."""
    logging.getLogger("can.interfaces.socketcand").setLevel(logging.ERROR)  # it warns of frames that TCP cut in two
    with can.Bus(interface="socketcand", channel="can0", host="127.0.0.1", port=port) as bus:
        time.sleep(0.5)  # the served bus sends no frames to a new client for a quarter of a second
        yield bus


def _send(bus: can.BusABC, identifier: int, data: bytes) -> None:
    bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))


_LOOKING_DOWN = np.array([0.0, 1.0, 0.0, 0.0])  # body from camera
_POLL_S = 0.5
_MOST_COUNTER = 240  # of a SYNC


@dataclass
class Connection:
    """The spacecraft's side of its links."""

    bus: can.BusABC
    pose_port: int  # UDP port at which the camera receives poses
    trouble: Callable[[], str]  # returns a text that names the process that has ended; "" while all run
    faults: Faults

    def __post_init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._poses_sent = self._syncs = 0
        self._estimate = b""

    def pose(self, t_s: float, state: State) -> None:
        """Send the pose of the camera at a stream time."""
        q = product(state.attitude, _LOOKING_DOWN)
        message = PoseMessage(round(t_s * 1e9), tuple(state.position_m), tuple(q), counter=self._poses_sent)
        self._poses_sent += 1
        if (data := self.faults.datagram(message, t_s)) is not None:
            self._socket.sendto(data, ("127.0.0.1", self.pose_port))

    def frame(self, t_s: float, identifier: int, data: bytes) -> None:
        """Send an attitude or a sample."""
        if not self.faults.loses_frame(t_s):
            _send(self.bus, identifier, data)

    def sync(self) -> int:
        """Send a SYNC; return its counter."""
        self._syncs = self._syncs % _MOST_COUNTER + 1
        _send(self.bus, SYNC, bytes([self._syncs]))
        return self._syncs

    def answer(self, t_s: float, turn: int, limit_s: float) -> tuple[Vector, bytes] | None:
        """Return the command that answers a turn, and the newest estimate; None when the bus lost it.

        Raises TimeoutError, with the cause, when none comes within `limit_s` of wall time, or when there is trouble.
        """
        end_s = time.monotonic() + limit_s
        while (left_s := end_s - time.monotonic()) > 0 and not self.trouble():
            message = self.receive(min(left_s, _POLL_S))
            if message is not None and message.arbitration_id == ESTIMATE:
                self._estimate = bytes(message.data)
            if message is not None and message.arbitration_id == COMMAND:
                command, answered = unpack_command(bytes(message.data))
                if self.faults.loses_frame(t_s):
                    return None
                if answered == turn % (1 << 16):
                    return command, self._estimate
        raise TimeoutError(self.trouble() or f"the flight computer did not answer within {limit_s:g} s")

    def receive(self, timeout_s: float) -> can.Message | None:
        """Return the next frame of the bus, if one comes in time."""
        return self.bus.recv(timeout_s)


_REQUEST_S = 0.5
_PATIENCE_S = 10.0  # longest wait for missing events, wall time: the line is stalled
_STANDS_S = 5.0  # longest wait for a camera whose time stands still, wall time: it receives no SYNC


@dataclass
class Links:
    """The flight computer's side of its two links, read in one thread without waiting for either.

    `edges` are SYNCs among the events: time, us, and counter on the bus. `arrivals` are reads of events: instant on
    CLOCK_MONOTONIC, ns, times of the oldest and the newest, us, and number.
    """

    path: str  # of the serial line
    bus: can.BusABC
    window: Window  # receives events
    take_frame: Callable[[int, bytes], None]  # receives identifier and data of each frame of the bus

    def __post_init__(self) -> None:
        self._port: int | None = None
        self._receiver = SerialReceiver("ccsds-cobs")
        self._received = self.syncs = self.lost = 0
        self.edges: list[tuple[int, int]] = []
        self.arrivals: list[tuple[int, int, int, int]] = []
        self._open()

    def complete(self, until_us: int = 0) -> None:
        """Read until every event that the camera had at the call, or had at `until_us`, has come or is lost.

        Returns at once without a serial line, after ten seconds where it is stalled, and after five where the camera
        answers but its time stands still.
        """
        end_s = time.monotonic() + _PATIENCE_S
        first = self._report(until_us, end_s)
        if first is None:
            return
        self.wait(lambda: self._received + self.lost >= first.events.sent, _REQUEST_S)
        if self._received + self.lost < first.events.sent and self._report(0, end_s) is not None:
            self.lost = max(self.lost, first.events.sent - self._received)

    def wait(self, done: Callable[[], bool], seconds: float) -> None:
        """Receive until something is done, at most so long, wall time."""
        end_s = time.monotonic() + seconds
        while not done() and time.monotonic() < end_s:
            self.receive(0.001)

    def receive(self, timeout_s: float) -> None:
        """Take what has come; wait for the serial line, or for a line that is not there."""
        if self._port is None and not self._open():
            time.sleep(timeout_s)
        elif self._port is not None:
            select.select([self._port], [], [], timeout_s)
            self._read_serial()
        while (message := self.bus.recv(0)) is not None:
            self.syncs += message.arbitration_id == SYNC
            self.take_frame(message.arbitration_id, bytes(message.data))

    def send(self, identifier: int, data: bytes) -> None:
        """Send a frame."""
        _send(self.bus, identifier, data)

    def _report(self, until_us: int, end_s: float) -> Housekeeping | None:
        """Return the next report of the camera in which no event waits; None when none comes."""
        before, requested_s = self._receiver.housekeeping, 0.0
        newest_us, stands_s = -1, math.inf
        while self._port is not None and time.monotonic() < min(end_s, stands_s):
            report = self._receiver.housekeeping
            if report is not None and report is not before:
                if not report.events.waiting and report.t_us >= until_us:
                    return report
                if report.t_us > newest_us:
                    newest_us, stands_s = report.t_us, time.monotonic() + _STANDS_S
            if time.monotonic() > requested_s + _REQUEST_S or report is not before:
                try:
                    os.write(self._port, self._receiver.wrap(RequestHousekeeping()))
                except OSError:
                    self._unplug()
                before, requested_s = report, time.monotonic()
            self.receive(0.01)
        return None

    def _open(self) -> bool:
        """Open the serial line; return whether it is there."""
        try:
            self._port = os.open(self.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            tty.setraw(self._port, termios.TCSANOW)
        except (OSError, termios.error):
            self._unplug()
        return self._port is not None

    def _unplug(self) -> None:
        if self._port is not None:
            os.close(self._port)
            self._port = None

    def _read_serial(self) -> None:
        assert self._port is not None
        try:
            while data := os.read(self._port, 1 << 16):
                self._receiver.push(data)
            self._unplug()  # a line without data raises; an end of file is a port that disappeared
        except BlockingIOError:
            pass
        except OSError:
            self._unplug()
        events, edges = self._receiver.take_events(), self._receiver.take_edges()
        if len(events):
            self._received += len(events)
            self.arrivals.append((time.monotonic_ns(), int(events["t"][0]), int(events["t"][-1]), len(events)))
            self.window.add_events(events)
        self.edges += zip(edges["t"].tolist(), edges["seq"].tolist(), strict=True)
