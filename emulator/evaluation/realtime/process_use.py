"""Processor time and memory of a process and of its children, as Linux counts them in /proc."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Meter", "ProcessUse", "children", "use_of"]

_PROC = Path("/proc")
_TICK_S = 1 / os.sysconf("SC_CLK_TCK")
_HELPER = b"resource_tracker"  # of multiprocessing: a child that does none of the run's work


@dataclass(frozen=True)
class ProcessUse:
    """Processor time of a process so far, s, and the most memory that it had at a time, MiB."""

    cpu_s: float
    peak_mib: float


def use_of(pid: int) -> ProcessUse | None:
    """Return the use of a process; None where it has ended."""
    try:
        fields = (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
        status = (_PROC / str(pid) / "status").read_text()
    except OSError:
        return None
    peak = [line for line in status.splitlines() if line.startswith("VmHWM:")]
    if not peak:  # it has ended, and its parent has not taken note of it
        return None
    return ProcessUse((int(fields[11]) + int(fields[12])) * _TICK_S, int(peak[0].split()[1]) / 1024)


def children(pid: int) -> Iterator[int]:
    """Yield the children of a process, and theirs, without helpers of multiprocessing."""
    for task in (_PROC / str(pid) / "task").glob("*/children"):
        with suppress(OSError):
            for child in map(int, task.read_text().split()):
                if not _is_helper(child):
                    yield child
                    yield from children(child)


def _is_helper(pid: int) -> bool:
    with suppress(OSError):
        return _HELPER in (_PROC / str(pid) / "cmdline").read_bytes()
    return True


class Meter:
    """Use of the processes of a run, from the first sample after its first step to the last."""

    def __init__(self, session: int, receiver: int) -> None:
        self._session, self._receiver = session, receiver
        self._first: dict[int, ProcessUse] = {}
        self._last: dict[int, ProcessUse] = {}
        self._links: set[int] = set()
        self.begun_s = self.last_s = 0.0

    def sample(self) -> None:
        """Take a sample of all processes."""
        self._links.update(children(self._session))
        found = {pid: use for pid in (self._session, self._receiver, *self._links) if (use := use_of(pid))}
        self.last_s = time.monotonic()
        self.begun_s = self.begun_s or self.last_s
        self._first = {**found, **self._first}
        self._last |= found

    @property
    def session_cores(self) -> float | None:
        """Cores of the session."""
        return self._cores({self._session})

    @property
    def link_cores(self) -> float | None:
        """Cores of all links together."""
        return self._cores(self._links)

    @property
    def receiver_cores(self) -> float | None:
        """Cores of the receiver."""
        return self._cores({self._receiver})

    @property
    def memory_mib(self) -> float:
        """Memory of the session and its links, MiB."""
        return sum(use.peak_mib for pid, use in self._last.items() if pid != self._receiver)

    def _cores(self, pids: set[int]) -> float | None:
        seconds = self.last_s - self.begun_s
        if seconds <= 0:
            return None
        return sum(self._last[pid].cpu_s - self._first[pid].cpu_s for pid in pids if pid in self._last) / seconds
