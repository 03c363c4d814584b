"""Resident memory of processes over a long run, and how it grows."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

__all__ = ["MemoryLog", "resident_bytes"]

MIB = 1 << 20


def resident_bytes(pid: int | None) -> int:
    """Return the resident memory of a process, of this one for None (VmRSS of /proc/PID/status)."""
    status = Path(f"/proc/{'self' if pid is None else pid}/status").read_text()
    return next(int(line.split()[1]) << 10 for line in status.splitlines() if line.startswith("VmRSS"))


class MemoryLog:
    """Samples of the resident memory of `processes` (name to process number), at most one each `period_s`."""

    def __init__(self, processes: dict[str, int | None], period_s: float = 1.0) -> None:
        self._processes = processes
        self._period_s = period_s
        self._next_s = time.monotonic()
        self._rows: list[tuple[float, ...]] = []

    def due(self) -> bool:
        """Tell whether a sample is due."""
        return time.monotonic() >= self._next_s

    def sample(self, progress: float) -> None:
        """Take one at `progress`, such as the number of events so far."""
        self._next_s = time.monotonic() + self._period_s
        self._rows.append((float(progress), *(float(resident_bytes(pid)) for pid in self._processes.values())))

    def grown(self) -> dict[str, float]:
        """Return by how many bytes the largest sample of the second half exceeds the smallest of it."""
        rows = np.array(self._rows)
        late = rows[rows[:, 0] >= rows[-1, 0] / 2]
        return {name: float(np.ptp(late[:, k])) for k, name in enumerate(self._processes, 1)}
