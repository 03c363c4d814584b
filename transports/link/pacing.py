"""Clocks that can be passed in, ticks on absolute deadlines, a selector for short waits, and the priority of a process.

Deadlines are absolute (start + k * period), so a late tick does not delay the next one. Wake-up errors of a plain sleep
on an idle machine are around 0.1 ms at the median and a few milliseconds at the 99th percentile. They move the delivery
of an event, never its time.

`FineSelector` combines epoll's number of descriptors with select's resolution. `select` fails above 1023 file
descriptors, and epoll waits for whole milliseconds only, which would double a tick of half a millisecond. An epoll set
is itself a file descriptor with a low number: `select` waits for that one.

A link must wait neither for the session that feeds it nor for other programs (`run_before_others`). Linux divides
processors by session first (autogroup), and by nice value within a session. A process that sleeps most of the time, in
a session of its own, runs as soon as it is ready, whatever the others do. Both values need a permission (root, or
'nice' in /etc/security/limits.conf); a session of its own needs none.
"""

from __future__ import annotations

import os
import select
import selectors
import time
from contextlib import suppress
from pathlib import Path
from typing import Protocol

MOST_NICE = -20
"""Nice value of a process that answers within milliseconds."""

LINK_NICE = -10
"""Nice value of a link's process."""

_AUTOGROUP = Path("/proc/self/autogroup")


class Clock(Protocol):
    """Clock of a run; nanoseconds since an arbitrary start, never decreasing."""

    def now_ns(self) -> int:
        """Return the current time, ns."""

    def processor_ns(self) -> int:
        """Return the processor time of the calling thread, ns."""

    def sleep_until(self, deadline_ns: int) -> None:
        """Return at `deadline_ns` or shortly after; at once if it has passed."""


class MonotonicClock:
    """Monotonic clock of the machine; the same in every process of the machine."""

    def now_ns(self) -> int:
        """Return CLOCK_MONOTONIC, ns."""
        return time.monotonic_ns()

    processor_ns = staticmethod(time.thread_time_ns)

    def sleep_until(self, deadline_ns: int) -> None:
        """Sleep until `deadline_ns`."""
        remaining_ns = deadline_ns - time.monotonic_ns()
        if remaining_ns > 0:
            time.sleep(remaining_ns * 1e-9)


def wall_less_monotonic_ns() -> int:
    """Return the difference of the two clocks by the fastest of three readings: a process may be stopped within one."""
    readings = []
    for _ in range(3):
        before_ns = time.monotonic_ns()
        wall_ns = time.time_ns()
        after_ns = time.monotonic_ns()
        readings.append((after_ns - before_ns, wall_ns - (before_ns + after_ns) // 2))
    return min(readings)[1]


class FakeClock:
    """Clock that a test sets; sleeping advances it too."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """Return the time that the test has set."""
        return self._now_ns

    processor_ns = now_ns  # no other program runs

    def sleep_until(self, deadline_ns: int) -> None:
        """Jump to `deadline_ns`."""
        self._now_ns = max(self._now_ns, deadline_ns)

    def advance(self, by_ns: int) -> None:
        """Advance the time by `by_ns`."""
        self._now_ns += by_ns


class FineSelector(selectors.DefaultSelector):
    """Best selector of the machine (epoll, kqueue) with wake-ups within microseconds of the deadline."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return the ready objects, at the latest after `timeout` seconds."""
        if (timeout is None or timeout > 0) and not select.select([self.fileno()], [], [], timeout)[0]:
            return []
        return super().select(0)


def run_before_others(nice: int) -> None:
    """Set a nice value and that of the session, as far as permitted; a process that leads none gets one of its own."""
    with suppress(PermissionError):  # it leads a group of processes, and so has its session
        os.setsid()
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, nice)
        with suppress(OSError):  # a kernel that divides processors by process has no such file
            _AUTOGROUP.write_text(str(nice))
