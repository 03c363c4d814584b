"""The process that answers hosts of a GigE Vision camera, and does nothing else.

    hosts --GVCP--> ControlSockets --> Triton2Control --answers--> hosts
                                             |
                                             +--orders--> the link's process

neuromorphic_drivers gives an answer 25 ms. So this process imports little, never collects garbage (it makes no cycles),
and runs before its link and others where that is allowed. An order is on its way to the link before its request is
answered. The process ends with the link, however that ends: its ends of the pipes close then.
"""

from __future__ import annotations

import gc
import mmap
import os
import select
import sys
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from firmware_protocol.gige.orders import DeviceTime
from firmware_protocol.gige.settings import GigeSettings
from firmware_protocol.gige.triton2_control import Triton2Control
from transports.gige.sockets import ControlSockets

__all__ = ["TIME_CELLS", "ControlSetup", "Failed", "Listening", "Move", "Mute", "Release", "Stop", "main", "read_time"]

TIME_CELLS = 2
"""Numbers of 64 bits in the shared memory: starts of the acquisition, and the device's clock, ns."""

_TURN_MS = 50
_COUNTS_PERIOD_NS = 100_000_000
_MOST_PRIORITY = 99
_LEAST_NICE = -20
_AUTOGROUP = Path("/proc/self/autogroup")


@dataclass(frozen=True)
class ControlSetup:
    """What the link says first."""

    host: str
    port: int
    allow: tuple[str, ...]
    settings: GigeSettings
    stream_port: int


@dataclass(frozen=True)
class Listening:
    """The sockets are open, at this port."""

    port: int


@dataclass(frozen=True)
class Failed:
    """The sockets cannot be opened."""

    errno: int | None
    told: str


@dataclass(frozen=True)
class Mute:
    """A fault: requests do not come, and answers do not go; or they do again."""

    on: bool


@dataclass(frozen=True)
class Release:
    """A fault: take control away from the host that has it."""


@dataclass(frozen=True)
class Move:
    """A fault: the camera is at another address from now on, at the same port, and sends its stream from another."""

    host: str
    stream_port: int


@dataclass(frozen=True)
class Stop:
    """The link ends: tell the last counts and end too."""


def read_time(cells: memoryview) -> DeviceTime:
    """Return what the link has written: first the clock, then the starts."""
    starts = cells[0]
    return DeviceTime(starts, cells[1])


class _Answering:
    def __init__(self, setup: ControlSetup, hears: Connection, says: Connection, cells: memoryview) -> None:
        self._hears, self._says = hears, says
        self._allow = setup.allow
        self._sockets = ControlSockets(setup.host, setup.port, setup.allow)
        self._sockets.open()
        self._control = Triton2Control(setup.settings, lambda: read_time(cells), setup.stream_port)
        self._room = select.poll()
        self._room.register(says, select.POLLOUT)
        self._news = select.poll()
        self._news.register(hears.fileno(), select.POLLIN)
        self._hear_sockets()
        self._told: Counter[str] = Counter()
        self._told_ns = 0
        self._mute = False
        says.send(Listening(self._sockets.port))

    def run(self) -> None:
        """Answer until the link stops."""
        is_over = False
        while not is_over:
            ready = self._news.poll(_TURN_MS)
            if any(descriptor == self._hears.fileno() for descriptor, _ in ready):
                is_over = self._obey(self._hears.recv())  # raises EOFError where the link ends without saying Stop
            else:
                self._turn()
        self._says.send(self._counts())

    def _hear_sockets(self) -> None:
        for descriptor in self._sockets.descriptors:
            self._news.register(descriptor, select.POLLIN)

    def _obey(self, word: Mute | Release | Move | Stop) -> bool:
        """Do what the link says; True at the end."""
        if isinstance(word, Mute):
            self._mute = word.on
        elif isinstance(word, Release):
            self._control.release()
            self._hand_on()
        elif isinstance(word, Move):
            self._move(word)
        return isinstance(word, Stop)

    def _move(self, to: Move) -> None:
        """Listen at another address; where that cannot be, say so and stay."""
        sockets = ControlSockets(to.host, self._sockets.port, self._allow)
        try:
            sockets.open()
        except OSError as error:
            self._says.send(Failed(error.errno, error.strerror or str(error)))
            return
        for descriptor in self._sockets.descriptors:
            self._news.unregister(descriptor)
        self._sockets.close()
        sockets.refused = self._sockets.refused
        self._sockets = sockets
        self._hear_sockets()
        self._control.move(to.host, to.stream_port)

    def _turn(self) -> None:
        now_ns = time.monotonic_ns()
        asked = self._sockets.take()
        answers = self._control.receive([] if self._mute else asked, now_ns)
        self._hand_on()
        for answer, peer in answers:
            self._sockets.send(answer, peer)
        if now_ns - self._told_ns > _COUNTS_PERIOD_NS and (counts := self._counts()) != self._told and self._has_room():
            self._says.send(counts)
            self._told, self._told_ns = counts, now_ns

    def _hand_on(self) -> None:
        """Send orders as far as the link takes them: one that is busy must not keep hosts waiting."""
        orders = self._control.orders
        while orders and self._has_room():
            self._says.send(orders.popleft())

    def _has_room(self) -> bool:
        return bool(self._room.poll(0))

    def _counts(self) -> Counter[str]:
        return self._control.counts + Counter({"requests of senders not allowed": self._sockets.refused})


def _run_before_others() -> None:
    """Take the best priority that is allowed: one above the link's real-time one, which was inherited, or nice -20."""
    with suppress(PermissionError):
        if os.sched_getscheduler(0) == os.SCHED_FIFO:
            priority = min(_MOST_PRIORITY, os.sched_getparam(0).sched_priority + 1)
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        else:
            os.setpriority(os.PRIO_PROCESS, 0, _LEAST_NICE)
            _run_before_other_sessions()


def _run_before_other_sessions() -> None:
    """Give this session the priority too: Linux shares processors out by session, and nice counts only within one.

    Without it an answer now and then waited for seconds on two cores with two busy processes.
    """
    with suppress(OSError):  # a kernel that shares out by process has no such file
        _AUTOGROUP.write_text(str(_LEAST_NICE))


def main() -> None:
    """Run the process; its arguments are the descriptors of two pipes, in and out, and of the shared memory."""
    _run_before_others()
    heard, said, memory = map(int, sys.argv[1:])
    hears, says = Connection(heard, writable=False), Connection(said, readable=False)
    cells = memoryview(mmap.mmap(memory, 8 * TIME_CELLS)).cast("q")
    with suppress(EOFError, ConnectionError):
        try:
            answering = _Answering(hears.recv(), hears, says, cells)
        except OSError as error:
            says.send(Failed(error.errno, error.strerror or str(error)))
            return
        gc.collect()
        gc.freeze()
        gc.disable()
        answering.run()
