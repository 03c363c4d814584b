"""A ring of records in shared memory: one writer process, one reader process.

    head   int64[3 + cells]   written | taken | refused | the owner's cells
    body   record[capacity]

`written` and `taken` count records since the start and never wrap (int64 lasts 24 000 years at 12 MHz); the
slot is the count modulo the capacity. The writer stores records first and then `written`; the reader loads them in the
opposite order, so what is counted is there. Both sides do aligned 8-byte loads and stores, which are atomic and ordered
on x86-64 and ordered by the interpreter's own locks elsewhere.
"""

from __future__ import annotations

import bisect
import multiprocessing
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["SharedRing"]

_WRITTEN, _TAKEN, _REFUSED, _CELLS = range(4)


class SharedRing:
    """Records with a time `t`, in time order, on their way to another process.

    Pass it as an argument to a process started by the spawn method; the memory goes with the last that holds it.

    Parameters
    ----------
    record
        Their dtype, with a field `t`, us.
    cells
        Further numbers that the owner shares.

    Attributes
    ----------
    cells
        These numbers, (cells,) int64.
    """

    def __init__(self, record: np.dtype[Any], capacity: int, cells: int = 0) -> None:
        if capacity < 1:
            raise ValueError(f"a ring holds at least one record, got capacity {capacity}")
        context = multiprocessing.get_context("spawn")
        self._memory = (
            context.RawArray("q", _CELLS + cells),
            context.RawArray("B", capacity * record.itemsize),
            record,
        )
        self._map()

    def _map(self) -> None:
        head, body, record = self._memory
        self._record = record
        # numpy copies these as bytes, and structured records field by field, 50 times slower
        self._raw = np.dtype(f"V{record.itemsize}")
        self._head = np.frombuffer(head, np.int64)
        self._body = np.frombuffer(body, self._raw)
        self.cells = self._head[_CELLS:]

    def __getstate__(self) -> tuple[Any, ...]:
        return self._memory

    def __setstate__(self, memory: tuple[Any, Any, np.dtype[Any]]) -> None:
        self._memory = memory
        self._map()

    @property
    def capacity(self) -> int:
        """Records that fit."""
        return len(self._body)

    @property
    def written(self) -> int:
        """Records written since the start."""
        return int(self._head[_WRITTEN])

    @property
    def waiting(self) -> int:
        """Records written and not yet taken."""
        return self.written - int(self._head[_TAKEN])

    @property
    def room(self) -> int:
        """Records that can be written now."""
        return self.capacity - self.waiting

    @property
    def refused(self) -> int:
        """Records that found no room, counted by the writer."""
        return int(self._head[_REFUSED])

    def push(self, records: npt.NDArray[Any]) -> int:
        """Write what fits of `records`, in order, and return how many that were; the rest is counted as refused."""
        n = min(len(records), self.room)
        written = self.written
        start = written % self.capacity
        first = min(n, self.capacity - start)
        raw = records.view(self._raw)
        self._body[start : start + first] = raw[:first]
        self._body[: n - first] = raw[first:n]
        self._head[_WRITTEN] = written + n
        self.refuse(len(records) - n)
        return n

    def refuse(self, count: int) -> None:
        """Count records as refused."""
        self._head[_REFUSED] += count

    def take(self, until_us: int, limit: int | None = None) -> npt.NDArray[Any]:
        """Take at most `limit` records with t <= `until_us`; returns a copy, shape (n,)."""
        taken = int(self._head[_TAKEN])
        there = self.written - taken
        n = self._due(taken, there if limit is None else min(there, max(limit, 0)), until_us)
        start = taken % self.capacity
        first = min(n, self.capacity - start)
        records = np.concatenate((self._body[start : start + first], self._body[: n - first])).view(self._record)
        self._head[_TAKEN] = taken + n
        return records

    def time_of(self, index: int) -> int | None:
        """Return `t` of the record that waits at `index`, us; None where there is none."""
        if index >= self.waiting:
            return None
        place = (int(self._head[_TAKEN]) + index) % self.capacity
        return int(self._body.view(self._record)["t"][place])

    def _due(self, taken: int, there: int, until_us: int) -> int:
        """Return how many of the next `there` records have t <= `until_us`."""
        times = self._body.view(self._record)["t"]
        return bisect.bisect_right(range(there), until_us, key=lambda i: int(times[(taken + i) % self.capacity]))
