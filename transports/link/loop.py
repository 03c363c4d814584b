"""Process of a link, and the ticks in its event loop: when something is due, a request or a publication comes.

    timer -------------------------------> turn: Link.tick, changes, a report ten times a second
    session --the ring's counter---------> a turn, because events were published that are due before the next one
    session --Stop, InjectFault, ... ---> acts at once, then a turn
    host ----bytes at an input-----------> Link.attend, then a turn, half a millisecond after the last one or later
    host ----bytes to an event loop------> Link.attend before they are processed, then a turn if the camera rested

Longest sleep from one tick to the next:

    a fault is active, edges come from another process,     0.5 ms   as data move, and as every link did before
    SYNCs are sent, data wait in the camera
    a host is present, nothing is due                       1 ms     time that its camera reports advances
    no host, a file, a run that is not paced and up to date 4 ms     only the ring of events must not fill

In a run that is not paced, edges that come from another process take the last of these times.

Events leave 0.1 ms after the time of the first of them, so that several leave together, and not within half a
millisecond of the last tick; of a dense stream (256 events a tick and more) a whole one, as the packets of a camera on
USB do, because a tick costs nearly the same for 300 events as for 1500.
"""

from __future__ import annotations

import asyncio
import gc
import os
import select
import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

from firmware_protocol.events import EdgeKind
from transports.faults.kinds import Fault
from transports.link.background_log import log_in_background
from transports.link.endpoint import LinkBroken
from transports.link.pacing import LINK_NICE, Clock, FineSelector, MonotonicClock, run_before_others
from transports.link.process import Link, LinkSetup
from transports.link.report import LinkReport
from transports.link.rings import FOREVER_US

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that end a run: to the session alone or to its whole process group."""

_REPORT_PERIOD_NS = 100_000_000
_LONGEST_DRAIN_TURN_NS = 5_000_000


@dataclass(frozen=True)
class Stop:
    """Request of the session to end: deliver the waiting data for at most `drain_s` of the link's own time.

    A turn counts with at most 5 ms, so that a link that was delayed by the machine or by compilation gets all its
    turns.
    """

    drain_s: float


@dataclass(frozen=True)
class InjectFault:
    """Request of the session to begin a fault now, of a kind that this link can have; `by`: name of the requester."""

    fault: Fault
    by: str = ""


@dataclass(frozen=True)
class EndFault:
    """Request of the session to end the fault with this number on its link; `by`: name of the requester."""

    number: int
    by: str = ""


@dataclass(frozen=True)
class Happen:
    """Request to apply an edge to the camera's input now, or (None) to reset its clock; `by`: name of the requester."""

    kind: EdgeKind | None
    by: str = ""


Order = InjectFault | EndFault | Happen


class LinkLoop:
    """Ticks of a link in the running event loop, made there; `turns`: number of turns so far."""

    def __init__(self, link: Link, control: Connection, clock: Clock) -> None:
        self._link = link
        self._control = control
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._over: asyncio.Future[None] = self._loop.create_future()
        self._timer: asyncio.Handle | None = None
        self._timer_ns = 0
        self._inputs: set[int] = set()
        self._report_ns = self._last_ns = clock.now_ns()
        self._drain_ns: int | None = None
        self.turns = 0

    async def run(self) -> None:
        """Tick until Stop came and the link is drained. Raises LinkBroken; EOFError, ConnectionError: session ended."""
        self._loop.add_reader(self._control.fileno(), self._call, self._obey)
        self._loop.add_reader(self._link.ring.wakes, self._call, self._follow_publication)
        self._link.endpoint.serve(partial(self._call, self._attend))
        self._wake_at(self._clock.now_ns())
        try:
            await self._over
        finally:
            self._end()

    def _end(self) -> None:
        self._link.ring.sleep(0)
        self._link.endpoint.serve(lambda: None)
        for descriptor in (self._control.fileno(), self._link.ring.wakes, *self._inputs):
            self._loop.remove_reader(descriptor)
        if self._timer is not None:
            self._timer.cancel()

    def _call(self, function: Callable[[], None]) -> None:
        """Call a function of this object; an error ends the loop."""
        if self._over.done():
            return
        try:
            function()
        except Exception as error:  # noqa: BLE001  # `run` raises it
            self._over.set_exception(error)

    def _wake_at(self, at_ns: int) -> None:
        """Set the next turn to `at_ns`, unless it is earlier already."""
        if self._timer is not None:
            if self._timer_ns <= at_ns:
                return
            self._timer.cancel()
        self._timer_ns = at_ns
        delay_ns = at_ns - self._clock.now_ns()
        if delay_ns > 0:
            self._timer = self._loop.call_later(delay_ns * 1e-9, self._call, self._turn)
        else:
            self._timer = self._loop.call_soon(self._call, self._turn)

    def _turn(self) -> None:
        """Tick, send changes and reports, and sleep."""
        self._timer = None
        self.turns += 1
        self._link.ring.sleep(0)
        self._link.tick()
        self._send_changes()
        now_ns = self._clock.now_ns()
        if self._drain_ns is not None:  # the session has sent Stop
            self._drain_ns -= min(now_ns - self._last_ns, _LONGEST_DRAIN_TURN_NS)
            self._last_ns = now_ns
            if self._link.idle or self._drain_ns < 0:
                self._over.set_result(None)
                return
        if now_ns >= self._report_ns:
            if _is_read(self._control):
                self._control.send(self._link.report())
            self._report_ns = now_ns + _REPORT_PERIOD_NS
        self._sleep()

    def _sleep(self) -> None:
        """Wait for the next turn.

        The writer of the ring wakes this process for everything from the first announcement on, so that nothing which
        is published while the next time is computed stays unnoticed.
        """
        link = self._link
        link.ring.sleep(FOREVER_US)
        next_ns = min(link.next_ns, self._report_ns)
        link.ring.sleep(link.asleep_us(next_ns))
        for descriptor in set(link.endpoint.inputs) ^ self._inputs:
            self._watch(descriptor)
        self._wake_at(next_ns)

    def _watch(self, descriptor: int) -> None:
        """Begin to watch an input, or cease."""
        if descriptor in self._inputs:
            self._inputs.remove(descriptor)
            self._loop.remove_reader(descriptor)
        else:
            self._inputs.add(descriptor)
            self._loop.add_reader(descriptor, self._call, partial(self._read, descriptor))

    def _read(self, descriptor: int) -> None:
        """Process a request at an input, which is watched again after the next turn."""
        self._watch(descriptor)
        soonest_ns = self._link.soonest_ns
        self._link.attend()
        self._wake_at(soonest_ns)

    def _attend(self) -> None:
        """Prepare for a request that an event loop delivers; the next turn reports its effects."""
        self._link.attend()
        if self._link.is_at_rest or not self._link.is_paced:
            self._wake_at(self._link.soonest_ns)

    def _follow_publication(self) -> None:
        self._link.ring.woken()
        self._wake_at(self._link.published_ns)

    def _obey(self) -> None:
        """Execute an order of the session."""
        order: Stop | Order = self._control.recv()
        if isinstance(order, Stop):
            self._drain_ns, self._last_ns = int(order.drain_s * 1e9), self._clock.now_ns()
            self._loop.remove_reader(self._control.fileno())
        else:
            self._link.attend()
            if isinstance(order, InjectFault):
                self._link.inject(order.fault, order.by)
            elif isinstance(order, EndFault):
                self._link.end_fault(order.number, order.by)
            else:
                self._link.happen(order.kind, order.by)
        self._wake_at(self._clock.now_ns())

    def _send_changes(self) -> None:
        """Send the changes of the camera, and after them its stream time."""
        changes = self._link.changes
        while changes and _is_read(self._control):
            self._control.send(changes.popleft())
        if not changes:
            self._link.settle()


def _is_read(control: Connection) -> bool:
    """Return True if the session reads reports: a busy session must not stop its links."""
    room = select.poll()
    room.register(control, select.POLLOUT)
    return bool(room.poll(0))


def run_link_process(setup: LinkSetup[Any], control: Connection) -> None:
    """Run one link in the process of which this is the target; the session, which computes all the time, yields to it.

    Orders of the session come through `control`, signals to its group of processes do not come here.
    """
    run_before_others(LINK_NICE)
    run_link(setup, control)


def run_link(setup: LinkSetup[Any], control: Connection) -> None:
    """Run one link until the session sends Stop or ends."""
    for number in STOP_SIGNALS:  # they are for the session, which then sends Stop
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)
    log = log_in_background()
    with (
        suppress(EOFError, ConnectionError),  # the session has ended: no process reads a report
        asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(FineSelector())) as runner,
    ):
        runner.run(_report_all(setup, control))
    log.drain()


async def _report_all(setup: LinkSetup[Any], control: Connection) -> None:
    """Open the link, run it, and send its reports; raises EOFError or ConnectionError when the session has ended."""
    clock = MonotonicClock()
    try:
        _take_priority(setup.fifo_priority)
        link = Link(setup, clock)
        await link.endpoint.start()
        gc.freeze()  # what is loaded stays: a full collection of numba's objects alone takes some ten milliseconds
    except OSError as error:
        control.send(LinkReport("failed", final=True, error=str(error)))
        return
    broken: str | None = None
    try:
        control.send(link.report())
        await LinkLoop(link, control, clock).run()
    except LinkBroken as error:
        broken = str(error)
    finally:
        await link.close()
    control.send(link.report(final=True, error=broken))


def _take_priority(fifo_priority: int) -> None:
    """Set the real-time priority of this process; raises OSError, with the remedy, if that is not permitted."""
    if not fifo_priority:
        return
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(fifo_priority))
    except PermissionError as error:
        raise OSError(
            f"may not run with run.fifo_priority = {fifo_priority}: leave it out, run as root, or give this user "
            "'rtprio' in /etc/security/limits.conf",
        ) from error
