"""The session's end of a link: it starts the process, receives its reports, and accounts for its events when it dies.

    starting ---> open ---> final report
                   |  ^
             died  v  | restart, where the rig requests it and the process had run for a second
                  gone

A link that is gone never ends the run. The events that were meant for it are counted as dropped, except those that its
process had delivered before (see `DeliveryTally`).

The start of a process does not depend on the program that starts the run, nor on signals that come meanwhile. A trace
can record the traffic on the USB cables of a run's links.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from firmware_protocol.device.items import ReadingKind, Readings
from firmware_protocol.events import Events
from firmware_protocol.recordings.part import RecordingSummary
from transports.link.deliveries import DeliveryTally
from transports.link.loop import STOP_SIGNALS, Order, Stop, run_link_process
from transports.link.pacing import Clock
from transports.link.process import LinkSetup
from transports.link.report import CameraSettings, LinkReport, Occurrence

_FOUND_BY = ("__file__", "__spec__")
_one_at_a_time = threading.Lock()


@contextmanager
def starting_a_process(*parts: object) -> Iterator[None]:
    """Start a process within this block that ignores the signals to the session, and needs no main module.

    `parts` are the factories that it receives.
    """
    with _signals_blocked(), _without_main_module(parts):
        yield


@contextmanager
def _signals_blocked() -> Iterator[None]:
    """Block the signals that end a run while a process starts: it inherits the mask, and then ignores them.

    A signal to the whole process group would otherwise end the new process before it has set its handlers.
    """
    resource_tracker.ensure_running()  # it unblocks SIGINT and SIGTERM when it starts, so it must run before
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _without_main_module(parts: tuple[object, ...]) -> Iterator[None]:
    """Start a process that does not import the main module again, unless one of `parts` is defined there.

    Else a script that starts a run without `if __name__ == "__main__":`, or one read from standard input, would fail.
    """
    main = sys.modules["__main__"]
    if "__main__" in map(_module_of, parts):
        yield
        return
    with _one_at_a_time:
        hidden: dict[str, Any] = {name: vars(main).pop(name) for name in _FOUND_BY if name in vars(main)}
        main.__spec__ = None
        try:
            yield
        finally:
            vars(main).update(hidden)


def _module_of(part: object) -> str:
    """Return the module in which a factory, or the function in it, is defined."""
    while isinstance(part, partial):
        part = part.func
    return str(getattr(part, "__module__", type(part).__module__))


_START_TIMEOUT_S = 180.0  # the first time, a link compiles its kernels: 10 s, and longer on a machine that is busy
_ROOM_WAIT_NS = 200_000
_SETTLE_WAIT_NS = 50_000
_RESTART_AFTER_NS = 1_000_000_000  # a process that dies sooner would die again


class LinkFailed(Exception):
    """A link could not start; the message contains its name and the reason."""


class LinkProcess:
    """One link in a process of its own.

    Attributes
    ----------
    name : the link's name in the rig.
    report : the newest report.
    gone : whether nothing more can be delivered.
    """

    def __init__(self, setup: LinkSetup[Any], clock: Clock) -> None:
        self.name = setup.name
        self._setup = setup
        self._clock = clock
        self._offered = self._delivered_before = 0
        self._recordings: tuple[RecordingSummary, ...] = ()
        self._changes: list[CameraSettings | Occurrence] = []
        self._starts = 0
        self._error: str | None = None
        self.gone = False
        self.report = LinkReport("starting")
        self._spawn()

    @property
    def pid(self) -> int | None:
        """Number of the process."""
        return self._process.pid

    def wait_ready(self) -> None:
        """Return when the link is open; raises LinkFailed."""
        if not self._control.poll(_START_TIMEOUT_S):
            raise LinkFailed(f"link {self.name!r} did not start within {_START_TIMEOUT_S:.0f} s")
        self.listen()
        if self.gone:
            raise LinkFailed(f"link {self.name!r}: {self._error}")

    def listen(self) -> LinkReport:
        """Read the reports that have come and return the newest; detect the death of the process."""
        try:
            while not self.gone and self._control.poll():
                self._take(self._control.recv())
        except (EOFError, ConnectionResetError):
            self._died()
        return self.report

    def start(self, origin_ns: int) -> None:
        """Start stream time; see EventRing.start."""
        self._setup.ring.start(origin_ns)

    def order(self, order: Order) -> None:
        """Begin a fault that the link can have, or end one; or give its camera's input an edge, or reset its clock."""
        with suppress(BrokenPipeError):  # it died: `listen` reports this
            self._control.send(order)

    def wait_settled(self, until_us: int, goes_on: Callable[[], bool]) -> None:
        """Wait until the camera has reached a stream time, and all changes before it can be taken.

        The wait also ends when `goes_on` returns False, or the link is gone.
        """
        while self._setup.ring.settled_us < until_us and not self.gone and goes_on():
            self._clock.sleep_until(self._clock.now_ns() + _SETTLE_WAIT_NS)
            self.listen()

    def take_changes(self, before_us: int) -> list[CameraSettings | Occurrence]:
        """Return the changes before a stream time that have come since the last call; of several settings the last."""
        self.listen()
        due = [change for change in self._changes if change.t_us < before_us]
        self._changes = [change for change in self._changes if change.t_us >= before_us]
        *_, last = None, *(change for change in due if isinstance(change, CameraSettings))
        return [change for change in due if change is last or isinstance(change, Occurrence)]

    def push(self, events: Events, now_us: int) -> None:
        """Hand over events up to `now_us`; events without room in the ring are refused and counted there."""
        self._offered += len(events)
        if not self.gone:
            self._setup.ring.push(events)
            self._setup.ring.publish(now_us)

    def push_all(self, events: Events, now_us: int, goes_on: Callable[[], bool] = lambda: True) -> None:
        """Hand over every event, and wait for room: for runs that are not paced, where nothing need be lost.

        The wait ends when `goes_on` returns False, or the link is gone; events without room are counted as dropped.
        """
        ring = self._setup.ring
        while len(events) > ring.room and not self.gone and goes_on():
            if ring.room == 0:
                self._clock.sleep_until(self._clock.now_ns() + _ROOM_WAIT_NS)
                self.listen()
                continue
            piece = events[: ring.room]
            self.push(piece, int(piece["t"][-1]))
            events = events[len(piece) :]
        self.push(events, now_us)

    def push_readings(self, kind: ReadingKind, readings: Readings, goes_on: Callable[[], bool] | None = None) -> None:
        """Hand over readings of a kind, before the events of the same time; those without room are refused and counted.

        In a run that is not paced, `goes_on` is given: it then waits for room, until the ring is empty.
        """
        ring = next((ring for ring in self._setup.readings if ring.kind == kind), None)
        if ring is None or self.gone or not len(readings):
            return
        while goes_on is not None and not ring.fits(readings) and ring.waiting and not self.gone and goes_on():
            self._clock.sleep_until(self._clock.now_ns() + _ROOM_WAIT_NS)
            self.listen()
        ring.push(readings)

    def stop(self, drain_s: float) -> LinkReport:
        """Close the ring, wait for the link to deliver its queue, and return its final report."""
        self._setup.ring.close()
        if not self.gone:
            self._finish(drain_s)
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join(5.0)
        if self._process.exitcode:
            self._setup.endpoint.remove_remains()
        return self._accounted()

    def _spawn(self) -> None:
        self._tally = DeliveryTally()
        self._began_ns = self._clock.now_ns()
        endpoint = self._setup.endpoint.restarted(self._starts) if self._starts else self._setup.endpoint
        recorder = self._setup.recorder
        if recorder is not None and self._starts:
            recorder = recorder.restarted(self._starts)
        setup = dataclasses.replace(self._setup, tally=self._tally, recorder=recorder, endpoint=endpoint)
        context = multiprocessing.get_context("spawn")
        self._control, theirs = context.Pipe()
        self._process = context.Process(
            target=run_link_process, args=(setup, theirs), name=f"evstim {self.name}", daemon=True
        )
        with starting_a_process(setup.device, setup.endpoint):
            self._process.start()
        theirs.close()
        self._starts += 1

    def _take(self, word: LinkReport | CameraSettings | Occurrence) -> None:
        if not isinstance(word, LinkReport):
            self._changes.append(word)
            return
        self.report = word
        if word.error is not None:
            self._leave(word.error, "failed")

    def _died(self) -> None:
        self._process.join(1.0)
        self._setup.endpoint.remove_remains()
        reason = f"its process ended (exit code {self._process.exitcode})"
        ran_ns = self._clock.now_ns() - self._began_ns
        if not self._setup.restart or ran_ns < _RESTART_AFTER_NS:
            self._leave(reason, "died")
            return
        self._delivered_before += self._tally.delivered
        self._recordings += self.report.recordings
        self._error = (
            f"{reason} and was started again {self._starts} times" if self._starts > 1 else f"{reason}; restarted"
        )
        self._spawn()
        self.report = LinkReport("restarting")
        self._changes.append(CameraSettings(self._setup.ring.settled_us, "restart"))

    def _leave(self, reason: str, state: str) -> None:
        self.gone = True
        self._error = reason
        self.report = dataclasses.replace(self.report, state=state, address=None)

    def _finish(self, drain_s: float) -> None:
        try:
            self._control.send(Stop(drain_s))
            while not self.report.final and self._control.poll(drain_s + 10.0):
                self._take(self._control.recv())
        except (EOFError, ConnectionError):
            self._leave(f"its process ended (exit code {self._process.exitcode})", "died")

    def _accounted(self) -> LinkReport:
        """Return the last report with a fate for every event that the link was offered."""
        report = self.report
        if report.final and self._error is None:
            return report
        if not report.final:  # its process was killed: the camera's own counters are as old as its last report
            report = dataclasses.replace(report, camera=None, delivered=self._tally.delivered, final=True)
        delivered = report.delivered + self._delivered_before
        dropped = self._offered - delivered - report.dropped_in_device
        recordings = (*self._recordings, *report.recordings)
        return dataclasses.replace(
            report, delivered=delivered, dropped=dropped, error=self._error, recordings=recordings
        )


def traced(setups: Sequence[LinkSetup[Any]], path: Path) -> tuple[list[LinkSetup[Any]], list[Path]]:
    """Return the links with a trace of those that have a USB cable, and the FILE of each trace.

    FILE is `path`, with the link's name behind it where there are several.
    """
    names = [setup.name for setup in setups if setup.endpoint.traced(path) is not None]
    paths = {name: path if len(names) == 1 else path.with_name(f"{path.name}-{name}") for name in names}
    links = []
    for setup in setups:
        endpoint = setup.endpoint.traced(paths[setup.name]) if setup.name in paths else None
        links.append(setup if endpoint is None else dataclasses.replace(setup, endpoint=endpoint))
    return links, list(paths.values())
