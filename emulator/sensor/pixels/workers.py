"""The threads of an array's step, and the buffers of its events.

The blocks are divided into shares, several for each thread, which the threads take in turn: one that must wait for a
core does not hold up the others. The events are merged. The number of threads follows from the work of the last step:
counts, no clock. The result is bit for bit that of one thread. The buffers of a step's events grow on demand and are
used again.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from emulator.sensor.pixels.candidates import new_table
from emulator.sensor.pixels.idle import Touched, new_idle
from emulator.sensor.pixels.state import Pixels, StepConstants
from emulator.sensor.pixels.step import RUN, Buffers, Share, Tally, advance, new_scratch, unpack, unpack_both
from emulator.sensor.pixels.subset import new_subset
from emulator.threads import available_threads

__all__ = ["EventBuffers", "Workers"]


_Keys = npt.NDArray[np.uint64]
_Frame = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]
_Moved = tuple[_Keys, list[Tally]]
"""Sorted events of the shares that one thread moved, and their counts."""

_WORTH_A_THREAD = 100_000
"""Quiet pixels that take as long as waking a thread pays for, about 100 us."""

_SHARES_A_THREAD = 4  # a share takes 20 us to begin

_CANDIDATE = 12
"""Cost of a candidate, in quiet pixels."""


class Workers:
    """The threads of one array.

    Parameters
    ----------
    blocks : int
        Blocks of the array.
    threads : int
        Always that many; 0: as the work of the last step suggests, at most those available.

    Attributes
    ----------
    idle : Idle
        The blocks that a step can skip.
    """

    def __init__(self, blocks: int, threads: int = 0) -> None:
        self.idle = new_idle(blocks)
        self._fixed, self._most = threads, threads or available_threads()
        self._buffers: list[Buffers] = []
        self._keys: list[_Keys] = []
        self._pool: ThreadPoolExecutor | None = None
        self._last = 0
        self._reserve(1)

    def buffers(self) -> Buffers:
        """Return those of the first thread."""
        return self._buffers[0]

    def step(self, frame: _Frame, pixels: Pixels, touched: Touched, c: StepConstants) -> tuple[list[_Keys], Tally]:
        """Move the array as `advance` does; return the keys in one or two sorted lists, and the counts."""
        n = self._wanted(frame[0].size)
        self._reserve(n)
        count = 1 if n == 1 else min(_SHARES_A_THREAD * n, _runs(frame[0].size))
        left = itertools.count()  # its next() is one step for the interpreter, so no share is taken twice

        def move(thread: int) -> _Moved:
            parts, tallies = [], []
            while (number := next(left)) < count:
                share = Share(number, count, self.idle, touched)
                keys, found, tally = advance(frame, pixels, self._buffers[thread], self._keys[thread], share, c)
                self._keys[thread] = keys
                parts.append(keys[:found] if count == 1 else keys[:found].copy())
                tallies.append(tally)
            keys = np.concatenate(parts) if len(parts) > 1 else parts[0] if parts else np.empty(0, np.uint64)
            keys.sort()
            return keys, tallies

        lists, tally = _merged(self._each(move, n))
        self._last = tally.moved + _CANDIDATE * tally.candidates
        return lists, tally

    def _wanted(self, pixels: int) -> int:
        runs = _runs(pixels)
        if self._fixed:
            return min(self._fixed, runs)
        return max(1, min(self._most, runs, self._last // _WORTH_A_THREAD))

    def _reserve(self, threads: int) -> None:
        while len(self._buffers) < threads:
            self._buffers.append(Buffers(new_table(), new_subset(0), new_scratch()))
            self._keys.append(np.empty(4096, np.uint64))

    def _each(self, move: Callable[[int], _Moved], n: int) -> list[_Moved]:
        """Return the results of all threads; the first is this one. One that has not begun at the end is not awaited."""
        if n == 1:
            return [move(0)]
        if self._pool is None:
            self._pool = ThreadPoolExecutor(max(self._most, n) - 1, thread_name_prefix="pixels")
        others = [self._pool.submit(move, thread) for thread in range(1, n)]
        own = move(0)
        return [own, *(other.result() for other in others if not other.cancel())]


def _runs(pixels: int) -> int:
    return -(-pixels // RUN)


def _merged(moved: list[_Moved]) -> tuple[list[_Keys], Tally]:
    """Return the events of all threads in at most two sorted lists, and the counts of all shares."""
    lists = [keys for keys, _ in moved]
    if len(lists) > 2:
        half = len(lists) // 2
        lists = [np.concatenate(part) for part in (lists[:half], lists[half:])]
        for part in lists:
            part.sort(kind="stable")  # merges the sorted parts
    tallies = [tally for _, several in moved for tally in several]
    return lists, Tally(*(sum(column) for column in zip(*tallies, strict=True)))


@dataclass(slots=True)
class EventBuffers:
    """Packed events, and times, pixels and polarities of unpacked ones."""

    keys: npt.NDArray[np.uint64] = field(default_factory=lambda: np.empty(4096, np.uint64))
    t_ns: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    pixel: npt.NDArray[np.uint32] = field(default_factory=lambda: np.empty(0, np.uint32))
    on: npt.NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, np.bool_))

    def add(self, lists: list[npt.NDArray[np.uint64]], packed: tuple[int, int], n: int) -> int:
        """Add the events of one or two sorted lists to the first n, and return the new number.

        `packed`: the time from which they count, ns, and the bits of a pixel's number.
        """
        found = sum(keys.size for keys in lists)
        if not found:
            return n
        self._reserve(n + found)
        out = self.t_ns[n:], self.pixel[n:], self.on[n:]
        if len(lists) == 1:
            unpack(lists[0], *packed, out)
        else:
            unpack_both((lists[0], lists[1]), *packed, out)
        return n + found

    def _reserve(self, n: int) -> None:
        """Provide space for n events; the present ones stay."""
        if n > self.t_ns.size:
            more = max(n, 2 * self.t_ns.size) - self.t_ns.size
            self.t_ns = np.concatenate([self.t_ns, np.empty(more, np.int64)])
            self.pixel = np.concatenate([self.pixel, np.empty(more, np.uint32)])
            self.on = np.concatenate([self.on, np.empty(more, np.bool_)])
