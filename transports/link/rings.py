"""Rings of records in shared memory, each with one writer process and one reader process.

    head   int64[3 + cells]   written | taken | refused | the owner's cells
    body   record[capacity]

`written` and `taken` count records since the start and never wrap (int64 lasts 24 000 years at 12 MHz); the slot is the
count modulo the capacity. The writer stores records first and then `written`; the reader loads them in the opposite
order, so all counted records are present. Both sides do aligned 8-byte loads and stores, which are atomic and ordered
on x86-64 and ordered by the interpreter's own locks elsewhere.

`EventRing` holds the events from the sensor to one link, and the stream time of the run. The writer pushes events first
and publishes `now_us` after them; the reader loads `now_us` before the events, so all events older than `now_us` are
present.

`ReadingRing` holds the readings of one kind from the session to one link, and in the other direction the settings of
the device's host.

    session --records--> ring --> link process: device.offer_readings
            <--numbers-- cells <-- link process: device.reading_settings

No call blocks: records without room are counted as refused. A frame is stored whole or not at all: if the whole frame
might find no room, its start and all its lines are refused. The numbers are written between two versions of a counter,
so that a reader that reads in between keeps the previous numbers.

A reader that sleeps stores the stream time until which it does so, looks at the ring once more, and sleeps. The writer
looks at that time after it has published, and adds to an event counter of the kernel if it published anything earlier.
Neither side has a memory barrier: if both miss the other's store, which takes nanoseconds, the reader wakes at the end
of its sleep.
"""

from __future__ import annotations

import bisect
import mmap
import os
import weakref
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.reduction import DupFd
from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.device.items import ReadingKind, Readings
from firmware_protocol.events import EVENT, Events
from firmware_protocol.frames import LineKind

_WRITTEN, _TAKEN, _REFUSED, _CELLS = range(4)
_VIEWS = ("_head", "_body", "_times", "cells")  # of the memory, in each process


class SharedMemory:
    """Zeroed `octets` that processes share: pass it as an argument to a process started by the spawn method.

    The memory of `multiprocessing` has a name in /dev/shm, which may be small or read-only; this one has none.
    """

    def __init__(self, size: int, inherited: Any = None) -> None:
        self._descriptor = inherited.detach() if inherited else os.memfd_create("evstim-ring")
        weakref.finalize(self, os.close, self._descriptor)
        os.ftruncate(self._descriptor, size)
        self.octets = mmap.mmap(self._descriptor, size)

    def __reduce__(self) -> tuple[Any, ...]:
        return SharedMemory, (len(self.octets), DupFd(self._descriptor))


class SharedRing:
    """Queue of records with a time `t`, in time order, to another process.

    Pass it as an argument to a process started by the spawn method; the last process that holds it frees the memory.

    Parameters
    ----------
    record : dtype of the records, with a field `t`, us.
    cells : number of further values that the owner shares.

    Attributes
    ----------
    cells : these values, (cells,) int64.
    """

    def __init__(self, record: np.dtype[Any], capacity: int, cells: int = 0) -> None:
        if capacity < 1:
            raise ValueError(f"a ring holds at least one record, got capacity {capacity}")
        self._record, self._numbers = record, _CELLS + cells
        # numpy copies these as bytes, but structured records field by field, which is 50 times slower
        self._raw = np.dtype(f"V{record.itemsize}")
        self._memory = SharedMemory(8 * self._numbers + capacity * record.itemsize)
        self._map()

    def _map(self) -> None:
        self._head = np.frombuffer(self._memory.octets, np.int64, self._numbers)
        self._body = np.frombuffer(self._memory.octets, self._raw, offset=self._head.nbytes)
        self._times = self._body.view(self._record)["t"]
        self.cells = self._head[_CELLS:]

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in _VIEWS}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._map()

    @property
    def capacity(self) -> int:
        """Capacity, records."""
        return len(self._body)

    @property
    def written(self) -> int:
        """Number of records written since the start."""
        return int(self._head[_WRITTEN])

    @property
    def waiting(self) -> int:
        """Number of records written and not yet taken."""
        return self.written - int(self._head[_TAKEN])

    @property
    def room(self) -> int:
        """Number of records that can be written now."""
        return self.capacity - self.waiting

    @property
    def next_us(self) -> int | None:
        """Time of the first waiting record, us; None if none waits."""
        return self.time_of(0)

    @property
    def refused(self) -> int:
        """Number of records for which there was no room, counted by the writer."""
        return int(self._head[_REFUSED])

    def push(self, records: npt.NDArray[Any]) -> int:
        """Write the records that fit, in order, and return their number; the others are counted as refused."""
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
        waiting = self.written - taken
        n = self._due(taken, waiting if limit is None else min(waiting, max(limit, 0)), until_us)
        if not n:
            return np.empty(0, self._record)
        start = taken % self.capacity
        first = self._body[start : start + n]  # up to the end of the memory
        wrapped = n - len(first)
        records = np.concatenate((first, self._body[:wrapped])) if wrapped else first.copy()
        self._head[_TAKEN] = taken + n
        return records.view(self._record)

    def time_of(self, index: int) -> int | None:
        """Return `t` of the waiting record at `index`, us; None if there is none."""
        if index >= self.waiting:
            return None
        return int(self._times[(int(self._head[_TAKEN]) + index) % self.capacity])

    def _due(self, taken: int, waiting: int, until_us: int) -> int:
        """Return how many of the next `waiting` records have t <= `until_us`."""
        times, capacity = self._times, self.capacity
        start = taken % capacity
        if waiting < 1 or times[start] > until_us:
            return 0
        if times[(taken + waiting - 1) % capacity] <= until_us:
            return waiting
        first = min(waiting, capacity - start)  # records before the end of the memory
        if first < waiting and times[capacity - 1] <= until_us:
            return first + bisect.bisect_right(times, until_us, 0, waiting - first)
        return bisect.bisect_right(times, until_us, start, start + first) - start


FREE_RUNNING = -1
"""Origin of a run without pacing: events may leave as soon as they are available."""

FOREVER_US = 1 << 62
"""Stream time that no run reaches."""

_NOW_US, _ORIGIN_NS, _CLOSED, _SETTLED_US, _ASLEEP_US, _CELLS_RING = range(6)


class EventRing(SharedRing):
    """Events from the sensor to one link, the stream time of both ends, and a counter that wakes the reader."""

    def __init__(self, capacity: int = 1 << 20) -> None:
        super().__init__(EVENT, capacity, _CELLS_RING)
        self._wakes = Connection(os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC))
        self._first_us = FOREVER_US

    @property
    def now_us(self) -> int:
        """Stream time that the writer has reached, us."""
        return int(self.cells[_NOW_US])

    @property
    def settled_us(self) -> int:
        """Stream time that the camera has reached, us, after its hosts' changes were sent; the reader writes it."""
        return int(self.cells[_SETTLED_US])

    @property
    def origin_ns(self) -> int | None:
        """Monotonic time at which stream time is zero, ns; FREE_RUNNING; None before the run starts."""
        return int(self.cells[_ORIGIN_NS]) or None

    @property
    def closed(self) -> bool:
        """True when the writer has finished."""
        return bool(self.cells[_CLOSED])

    def start(self, origin_ns: int) -> None:
        """Start the run: stream time zero is at monotonic time `origin_ns`, or FREE_RUNNING."""
        self.cells[_ORIGIN_NS] = origin_ns
        self._wake(0)

    def close(self) -> None:
        """Mark the ring as finished: no further events are written."""
        self.cells[_CLOSED] = 1

    def push(self, events: Events) -> int:
        """Write events, (n,) EVENT, as many as there is room for; return their number."""
        if not len(events):
            return 0
        self._first_us = min(self._first_us, int(events["t"][0]))
        return super().push(events)

    def publish(self, now_us: int) -> None:
        """Publish the stream time `now_us`: every earlier event has been pushed. Wake a reader that sleeps too long."""
        self.cells[_NOW_US] = now_us
        first_us, self._first_us = self._first_us, FOREVER_US
        self._wake(min(first_us, now_us))

    def _wake(self, t_us: int) -> None:
        """Wake a reader that sleeps beyond `t_us`, once for each sleep."""
        cells = self.cells
        if cells[_ASLEEP_US] > t_us:
            cells[_ASLEEP_US] = 0
            os.eventfd_write(self._wakes.fileno(), 1)

    @property
    def wakes(self) -> int:
        """Descriptor that becomes readable when the writer wakes the reader; `woken` makes it unreadable again."""
        return self._wakes.fileno()

    def sleep(self, until_us: int) -> None:
        """Announce that the reader sleeps until the stream time `until_us`; 0: it is awake, and is not woken."""
        self.cells[_ASLEEP_US] = until_us

    def woken(self) -> None:
        """Remove the wake-ups that the writer has written."""
        with suppress(BlockingIOError):
            os.eventfd_read(self._wakes.fileno())

    def settle(self, until_us: int) -> None:
        """Store the stream time that the camera has reached, after the earlier changes of its hosts have been sent."""
        self.cells[_SETTLED_US] = until_us


MOST_NUMBERS = 16
"""Highest number of settings of a device for one kind of readings."""

_VERSION, _COUNT, _NUMBERS = range(3)
_MOMENTS = 4  # records of a frame, beside the two reads of each line


class ReadingRing(SharedRing):
    """Readings from the session to one link, and its host's settings the other way; `record`: dtype with `t`, us."""

    def __init__(self, kind: ReadingKind, record: np.dtype[Any], capacity: int) -> None:
        self.kind = kind
        super().__init__(record, capacity, _NUMBERS + MOST_NUMBERS)
        self._settings: tuple[int, ...] = ()
        self._longest = 2 * record["samples"].shape[0] + _MOMENTS if kind is ReadingKind.FRAMES else 0
        if capacity < self._longest:
            raise ValueError(f"a ring of frames holds at least one, {self._longest} records, got capacity {capacity}")
        self._refusing = False

    def fits(self, records: Readings) -> bool:
        """Return True if all of `records` can be written now."""
        starts = self._starts(records)
        return max(len(records), starts[-1] + self._longest if starts else 0) <= self.room

    def push(self, records: Readings) -> int:
        """Write readings, and return their number; a frame is written whole or refused whole."""
        return sum(self._push_part(part) for part in np.split(records, self._starts(records)) if len(part))

    def _push_part(self, part: Readings) -> int:
        """Write records of which only the first may be the start of a frame."""
        if self._starts(part):
            self._refusing = self.room < self._longest
        if self._refusing:
            self.refuse(len(part))
            return 0
        return super().push(part)

    def _starts(self, records: Readings) -> list[int]:
        """Return the indices at which frames start."""
        return np.flatnonzero(records["kind"] == LineKind.START).tolist() if self._longest else []

    @property
    def settings(self) -> tuple[int, ...]:
        """Newest settings that the link process wrote, see `TakesReadings.reading_settings`; empty before."""
        cells = self.cells
        for _ in range(100):
            version = int(cells[_VERSION])
            numbers = tuple(int(n) for n in cells[_NUMBERS : _NUMBERS + int(cells[_COUNT])])
            if version % 2 == 0 and int(cells[_VERSION]) == version:
                self._settings = numbers
                break
        return self._settings

    def write_settings(self, settings: tuple[int, ...]) -> None:
        """Write the settings of the device's host; for the link process, and the process that makes the ring."""
        if settings == self._settings:
            return
        cells = self.cells
        cells[_VERSION] += 1
        cells[_COUNT] = len(settings)
        cells[_NUMBERS : _NUMBERS + len(settings)] = settings
        cells[_VERSION] += 1
        self._settings = settings
