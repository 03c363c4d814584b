"""The process that answers hosts of a GigE Vision camera, and does nothing else.

    hosts --GVCP--> ControlSockets --> Triton2Control --answers--> hosts
                                             |
                                             +--orders--> the link's process

neuromorphic_drivers gives an answer 25 ms. So this process imports little, never collects garbage (it makes no cycles),
and runs before its link and others where that is allowed. An order is on its way to the link before its request is
answered. The process ends with the link, however that ends: its ends of the pipes close then.

The link's side of the process that answers hosts: it is started, gives orders, and is told the device's clock.

the link -- ControlSetup, Stop --> transports.gige.answering
         -- device's clock ------>     (shared memory)
         <-- Listening, orders, counts
"""

from __future__ import annotations

import fcntl
import gc
import mmap
import os
import select
import struct
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from firmware_protocol.gige.control import DeviceTime, Order
from firmware_protocol.gige.registers import GigeSettings
from firmware_protocol.gige.triton2_control import Triton2Control
from transports.gige.sockets import ControlSockets
from transports.link.endpoint import LinkBroken

__all__ = [
    "TIME_CELLS",
    "ControlProcess",
    "ControlSetup",
    "Failed",
    "Listening",
    "Move",
    "Mute",
    "Release",
    "Stop",
    "main",
    "read_time",
]


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


_START_S = 120.0  # on a machine that is very busy
_END_S = 10.0
_AT_A_TIME = 1024
_PIPE_OCTETS = 1 << 20  # orders of a link that stands still for a while
_MAIN = "from transports.gige.answering import main; main()"
_TIME = struct.Struct("=q")


class ControlProcess:
    """A camera's control channel in a process of its own.

    Raises OSError, with what to do, when it cannot be started or an address cannot be used.

    Attributes
    ----------
    counts
        Requests by what became of them.
    port
        Where it listens.
    """

    def __init__(self, setup: ControlSetup) -> None:
        memory = os.memfd_create("evstim-gige-time")
        os.ftruncate(memory, 8 * TIME_CELLS)
        self._time = mmap.mmap(memory, 8 * TIME_CELLS)
        heard, says = os.pipe()
        hears, said = os.pipe()
        with suppress(OSError):  # more pipes than this user may have: a shorter one will do
            fcntl.fcntl(hears, fcntl.F_SETPIPE_SZ, _PIPE_OCTETS)
        self._says, self._hears = Connection(says, readable=False), Connection(hears, writable=False)
        self._process = _started(heard, said, memory)
        for descriptor in (heard, said, memory):
            os.close(descriptor)
        self.counts: Counter[str] = Counter()
        self._says.send(setup)
        self.port = self._listening()

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def take(self) -> Iterator[Order]:
        """Give what has been ordered; raises LinkBroken when the process has died, or cannot be where it is to be."""
        for _ in range(_AT_A_TIME):
            try:
                if not self._hears.poll():
                    return
                told = self._hears.recv()
            except (EOFError, ConnectionError) as error:
                how = f"exit code {self._process.wait(_END_S)}"
                raise LinkBroken(f"the process that answers GigE Vision hosts has died ({how})") from error
            if isinstance(told, Failed):
                raise LinkBroken(told.told)
            if isinstance(told, Counter):
                self.counts = told
            else:
                yield told

    def tell(self, time: DeviceTime) -> None:
        """Say what the device's clock is: see `read_time`."""
        _TIME.pack_into(self._time, 8, time.ns)
        _TIME.pack_into(self._time, 0, time.starts)

    def order(self, word: Mute | Release | Move) -> None:
        """Have a fault of the control channel begin or end; one that has died is told of by `take`."""
        with suppress(ConnectionError):
            self._says.send(word)

    def close(self) -> None:
        """End it; its last counts are taken, orders that wait are not."""
        try:
            self._says.send(Stop())
            while True:
                told = self._hears.recv()
                self.counts = told if isinstance(told, Counter) else self.counts
        except (EOFError, ConnectionError):
            self._end()

    def _listening(self) -> int:
        """Return the port; raises OSError when there is none."""
        try:
            told = self._hears.recv() if self._hears.poll(_START_S) else None
        except EOFError:
            told = None
        if isinstance(told, Listening):
            return told.port
        self._end()
        if isinstance(told, Failed):
            raise OSError(told.errno, told.told)
        raise OSError("the process that answers GigE Vision hosts does not start; what it says is above")

    def _end(self) -> None:
        self._process.kill()
        self._process.wait()
        self._says.close()
        self._hears.close()
        self._time.close()


def _started(*descriptors: int) -> subprocess.Popen[bytes]:
    """Start the process in a session of its own: Linux shares processors out by session (autogroup)."""
    return subprocess.Popen(
        [sys.executable, "-c", _MAIN, *map(str, descriptors)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        pass_fds=descriptors,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)},
    )
