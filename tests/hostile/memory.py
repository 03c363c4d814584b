"""Resident memory of processes over a long run, and how it grows."""

import time
from pathlib import Path

import numpy as np

__all__ = ["MemoryLog", "resident_bytes"]

MIB = 1 << 20


def resident_bytes(pid):
    """Return the resident memory of a process, of this one for None (VmRSS of /proc/PID/status)."""
    status = Path(f"/proc/{'self' if pid is None else pid}/status").read_text()
    return next(int(line.split()[1]) << 10 for line in status.splitlines() if line.startswith("VmRSS"))


class MemoryLog:
    """Samples of the resident memory of `processes` (name to process number), at most one each `period_s`."""

    def __init__(self, processes, period_s=1.0):
        self._processes = processes
        self._period_s = period_s
        self._next_s = time.monotonic()
        self._rows = []

    def due(self):
        """Tell whether a sample is due."""
        return time.monotonic() >= self._next_s

    def sample(self, progress):
        """Take one at `progress`, such as the number of events so far."""
        self._next_s = time.monotonic() + self._period_s
        self._rows.append((float(progress), *(float(resident_bytes(pid)) for pid in self._processes.values())))

    def grown(self):
        """Return by how many bytes the largest sample of the second half exceeds the smallest of it."""
        rows = np.array(self._rows)
        late = rows[rows[:, 0] >= rows[-1, 0] / 2]
        return {name: float(np.ptp(late[:, k])) for k, name in enumerate(self._processes, 1)}
