"""Process that answers the hosts of a GigE Vision camera.

    hosts --GVCP--> ControlSockets --> Triton2Control --answers--> hosts
                                             |
                                             +--orders--> the link's process
    masters <--PTP--> PtpPort --> timebase ------(shared memory)------> the link's process

neuromorphic_drivers waits 25 ms for an answer. So this process imports little, never collects garbage (it makes no
cycles), and runs with a higher priority than its link and other processes, if that is permitted. An order is sent to
the link before its request is answered. The process ends with the link, because its ends of the pipes close then.

`ControlProcess` (`transports.gige.endpoint`) is the interface of the link to it.
"""

from __future__ import annotations

import gc
import mmap
import os
import select
import struct
import sys
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection

from firmware_protocol.gige.control import DeviceTime
from firmware_protocol.imx636.triton2_control import PtpClock, Triton2Control, ptp_identity
from firmware_protocol.imx636.triton2_registers import Triton2Settings
from firmware_protocol.ptp.slave import Slave, Timebase
from transports.gige.ptp_port import PtpPort, ptp_slave
from transports.gige.sockets import ControlSockets
from transports.link.pacing import MOST_NICE, run_before_others

TIME_CELLS = 7
"""Number of 64-bit values in the shared memory.

Of the link: starts of the acquisition, and the device's clock, ns. Of the process that answers: number of writes, odd
during one; 1 if there is a master's time; and that time as a `Timebase`.
"""

_TURN_MS = 50
_COUNTS_PERIOD_NS = 100_000_000
_MOST_PRIORITY = 99
_TIMEBASE = struct.Struct("=5q")
_TIMEBASE_AT = 16
_MOST_NS = (1 << 63) - 1


@dataclass(frozen=True)
class ControlSetup:
    """First message of the link."""

    host: str
    port: int
    allow: tuple[str, ...]
    settings: Triton2Settings
    stream_port: int


@dataclass(frozen=True)
class Listening:
    """Message: the sockets are open, at this port."""

    port: int


@dataclass(frozen=True)
class Failed:
    """Message: the sockets cannot be opened."""

    errno: int | None
    reason: str


@dataclass(frozen=True)
class Mute:
    """Fault: requests and answers are discarded while `on`."""

    on: bool


@dataclass(frozen=True)
class Release:
    """Fault: take control away from the host that has it."""


@dataclass(frozen=True)
class Move:
    """Fault: the camera has another address from now on, at the same port, and sends its stream from another port."""

    host: str
    stream_port: int


@dataclass(frozen=True)
class Stop:
    """Request of the link to send the last counts and end."""


def write_timebase(memory: mmap.mmap, timebase: Timebase | None) -> None:
    """Write the relation of a master's time to the local clock; None: there is none."""
    (writes, *_) = _TIMEBASE.unpack_from(memory, _TIMEBASE_AT)
    values = (0, 0, 0, 0) if timebase is None else (1, timebase.local_ns, timebase.time_ns, timebase.rate_ppb)
    limited = [max(-_MOST_NS, min(_MOST_NS, value)) for value in values]
    struct.pack_into("=q", memory, _TIMEBASE_AT, writes + 1)
    struct.pack_into("=4q", memory, _TIMEBASE_AT + 8, *limited)
    struct.pack_into("=q", memory, _TIMEBASE_AT, writes + 2)


def read_timebase(memory: mmap.mmap, before: Timebase | None) -> Timebase | None:
    """Return what `write_timebase` wrote; `before`, which was read last, if it is being written now."""
    writes, has_master, *numbers = _TIMEBASE.unpack_from(memory, _TIMEBASE_AT)
    (writes_after,) = struct.unpack_from("=q", memory, _TIMEBASE_AT)
    if writes % 2 or writes != writes_after:
        return before
    return Timebase(*numbers) if has_master else None


class _Answering:
    def __init__(self, setup: ControlSetup, incoming: Connection, outgoing: Connection, memory: mmap.mmap) -> None:
        self._incoming, self._outgoing = incoming, outgoing
        self._memory = memory
        cells = memoryview(memory).cast("q")
        self._allow = setup.allow
        self._sockets = ControlSockets(setup.host, setup.port, setup.allow)
        self._sockets.open()
        self._slave: Slave | None
        self._ptp: PtpPort | None
        self._slave, self._ptp = _ptp(setup)
        self._timebase: Timebase | None = None
        clock = None if self._slave is None else PtpClock(self._slave, time.monotonic_ns)
        self._control = Triton2Control(setup.settings, lambda: DeviceTime(cells[0], cells[1]), setup.stream_port, clock)
        self._room = select.poll()
        self._room.register(outgoing, select.POLLOUT)
        self._news = select.poll()
        self._news.register(incoming.fileno(), select.POLLIN)
        self._watch_sockets()
        self._sent: Counter[str] = Counter()
        self._sent_ns = 0
        self._mute = False
        outgoing.send(Listening(self._sockets.port))

    def run(self) -> None:
        """Answer until the link stops."""
        is_over = False
        while not is_over:
            ready = self._news.poll(_TURN_MS)
            if any(descriptor == self._incoming.fileno() for descriptor, _ in ready):
                is_over = self._obey(self._incoming.recv())  # raises EOFError if the link ends without Stop
            else:
                self._turn()
        self._outgoing.send(self._counts())

    def _watch_sockets(self) -> None:
        for descriptor in self._sockets.descriptors:
            self._news.register(descriptor, select.POLLIN)
        self._ptp_descriptors: list[int] = []
        self._watch_ptp()

    def _watch_ptp(self) -> None:
        for descriptor in self._ptp_descriptors:
            with suppress(KeyError):
                self._news.unregister(descriptor)
        self._ptp_descriptors = [] if self._ptp is None else self._ptp.descriptors
        for descriptor in self._ptp_descriptors:
            self._news.register(descriptor, select.POLLIN)

    def _obey(self, order: Mute | Release | Move | Stop) -> bool:
        """Execute an order of the link; return True for Stop."""
        if isinstance(order, Mute):
            self._mute = order.on
        elif isinstance(order, Release):
            self._control.release()
            self._send_orders()
        elif isinstance(order, Move):
            self._move(order)
        return isinstance(order, Stop)

    def _move(self, to: Move) -> None:
        """Listen at another address; if that is not possible, report the failure and stay."""
        sockets = ControlSockets(to.host, self._sockets.port, self._allow)
        try:
            sockets.open()
        except OSError as error:
            self._outgoing.send(Failed(error.errno, error.strerror or str(error)))
            return
        for descriptor in self._sockets.descriptors:
            self._news.unregister(descriptor)
        self._sockets.close()
        sockets.refused = self._sockets.refused
        self._sockets = sockets
        self._watch_sockets()
        if self._ptp is not None:
            self._ptp.move(to.host)
            self._watch_ptp()
        self._control.move(to.host, to.stream_port)

    def _turn(self) -> None:
        now_ns = time.monotonic_ns()
        self._turn_ptp()
        requests = self._sockets.take()
        answers = self._control.receive([] if self._mute else requests, now_ns)
        self._send_orders()
        for answer, peer in answers:
            self._sockets.send(answer, peer)
        if now_ns - self._sent_ns > _COUNTS_PERIOD_NS and (counts := self._counts()) != self._sent and self._has_room():
            self._outgoing.send(counts)
            self._sent, self._sent_ns = counts, now_ns

    def _turn_ptp(self) -> None:
        """Follow the master; write the master's time for the link before a host can read that it is there."""
        if self._ptp is None or self._slave is None:
            return
        if self._ptp.turn(is_mute=self._mute):
            self._watch_ptp()
        if self._slave.timebase != self._timebase:
            self._timebase = self._slave.timebase
            write_timebase(self._memory, self._timebase)

    def _send_orders(self) -> None:
        """Send orders while the link's pipe has room: a busy link must not delay the answers to hosts."""
        orders = self._control.orders
        while orders and self._has_room():
            self._outgoing.send(orders.popleft())

    def _has_room(self) -> bool:
        return bool(self._room.poll(0))

    def _counts(self) -> Counter[str]:
        refused = Counter({"requests of senders not allowed": self._sockets.refused})
        if self._slave is None or self._ptp is None:
            return self._control.counts + refused
        return self._control.counts + refused + self._slave.counts + self._ptp.counts


def _ptp(setup: ControlSetup) -> tuple[Slave, PtpPort] | tuple[None, None]:
    """Return the clock and its port, if the camera has them; raises OSError."""
    if not setup.settings.ptp:
        return None, None
    slave = ptp_slave(ptp_identity(setup.settings), setup.settings.ptp_domain)
    return slave, PtpPort(slave, setup.host, setup.allow)


def _run_before_others() -> None:
    """Set the highest permitted priority: one above the link's inherited real-time priority, or nice -20.

    Without it some answers waited for seconds on two cores with two busy processes.
    """
    if os.sched_getscheduler(0) != os.SCHED_FIFO:
        run_before_others(MOST_NICE)
        return
    with suppress(PermissionError):
        priority = min(_MOST_PRIORITY, os.sched_getparam(0).sched_priority + 1)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


def main() -> None:
    """Run the process; its arguments are the descriptors of two pipes, in and out, and of the shared memory."""
    _run_before_others()
    incoming_fd, outgoing_fd, memory = map(int, sys.argv[1:])
    incoming, outgoing = Connection(incoming_fd, writable=False), Connection(outgoing_fd, readable=False)
    shared = mmap.mmap(memory, 8 * TIME_CELLS)
    with suppress(EOFError, ConnectionError):
        try:
            answering = _Answering(incoming.recv(), incoming, outgoing, shared)
        except OSError as error:
            outgoing.send(Failed(error.errno, error.strerror or str(error)))
            return
        gc.collect()
        gc.freeze()
        gc.disable()
        answering.run()
