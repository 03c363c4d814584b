"""The session's end of a link: starts its process, hears its reports, tells it to stop."""

from __future__ import annotations

import multiprocessing
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

from firmware_protocol.events import Events
from transports.faults.kinds import Fault
from transports.link.pacing import Clock
from transports.link.process import LinkReport, LinkSetup, Stop, Throw, run_link

__all__ = ["LinkFailed", "LinkProcess"]

_START_TIMEOUT_S = 180.0  # the first time, a link compiles its kernels: 10 s, and longer on a machine that is busy
_ROOM_WAIT_NS = 200_000
_FOUND_BY = ("__file__", "__spec__")
_starting = threading.Lock()


class LinkFailed(Exception):
    """A link could not start, or its process died; the message says which and why."""


class LinkProcess:
    """One link in a process of its own."""

    def __init__(self, setup: LinkSetup[Any], clock: Clock) -> None:
        self.name = setup.name
        self._ring = setup.ring
        self._clock = clock
        context = multiprocessing.get_context("spawn")
        self._control, theirs = context.Pipe()
        self._process = context.Process(target=run_link, args=(setup, theirs), name=f"evstim {setup.name}", daemon=True)
        with _without_main_module(setup):
            self._process.start()
        theirs.close()
        self.report = LinkReport("starting")

    def wait_ready(self) -> None:
        """Return when the link is open; raises LinkFailed."""
        if not self._control.poll(_START_TIMEOUT_S):
            raise LinkFailed(f"link {self.name!r} did not start within {_START_TIMEOUT_S:.0f} s")
        self.listen()

    def listen(self) -> LinkReport:
        """Take the reports that have come and return the newest; raises LinkFailed when the process has died."""
        try:
            while self._control.poll():
                self.report = self._control.recv()
        except (EOFError, ConnectionResetError) as gone:
            raise LinkFailed(f"the process of link {self.name!r} ended (exit code {self._process.exitcode})") from gone
        if self.report.error is not None:
            raise LinkFailed(f"link {self.name!r}: {self.report.error}")
        return self.report

    def start(self, origin_ns: int) -> None:
        """Let stream time run; see EventRing.start."""
        self._ring.start(origin_ns)

    def throw(self, fault: Fault) -> None:
        """Let a fault begin on it, one that it can have."""
        with suppress(BrokenPipeError):  # it died: `listen` will say so
            self._control.send(Throw(fault))

    def push(self, events: Events, now_us: int) -> None:
        """Hand over events up to `now_us`; what finds no room in the ring is refused and counted there."""
        self._ring.push(events)
        self._ring.publish(now_us)

    def push_all(self, events: Events, now_us: int, goes_on: Callable[[], bool] = lambda: True) -> None:
        """Hand over every event, waiting for room: for runs that are not paced, where nothing need be lost.

        When `goes_on` says no, it waits no longer, and what finds no room is refused and counted.
        """
        while len(events) > self._ring.room and goes_on():
            if self._ring.room == 0:
                self._clock.sleep_until(self._clock.now_ns() + _ROOM_WAIT_NS)
                self.listen()
                continue
            piece = events[: self._ring.room]
            self._ring.push(piece)
            self._ring.publish(int(piece["t"][-1]))
            events = events[len(piece) :]
        self.push(events, now_us)

    def stop(self, drain_s: float) -> LinkReport:
        """Close the ring, let the link deliver what waits, and return its final report."""
        self._ring.close()
        try:
            self._control.send(Stop(drain_s))
            while not self.report.final and self._control.poll(drain_s + 10.0):
                self.report = self._control.recv()
        except (EOFError, ConnectionError):
            pass  # it died before us; its last report stands, and the ledger will show what is missing
        self._process.join(5.0)
        if self._process.is_alive():
            self._process.kill()
        return self.report


@contextmanager
def _without_main_module(setup: LinkSetup[Any]) -> Iterator[None]:
    """Start a process that does not import the main module again, unless a part of `setup` is defined there.

    Else a script that starts a run without `if __name__ == "__main__":`, or one read from standard input, would fail.
    """
    main = sys.modules["__main__"]
    if "__main__" in (_module_of(setup.device), _module_of(setup.endpoint)):
        yield
        return
    with _starting:
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
