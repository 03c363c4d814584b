"""The threads of an array's step, and the buffers of its events.

Each thread moves a share of the blocks, and the events are merged. The number of threads follows from the work of the
last step: counts, no clock. The result is bit for bit that of one thread. The buffers of a step's events grow on demand
and are used again.
"""

from __future__ import annotations

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

_Keys = npt.NDArray[np.uint64]
_Frame = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]

_WORTH_A_THREAD = 100_000
"""Quiet pixels that take as long as waking a thread pays for, about 100 us."""

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

        def move(number: int) -> tuple[_Keys, Tally]:
            share = Share(number, n, self.idle, touched)
            keys, found, tally = advance(frame, pixels, self._buffers[number], self._keys[number], share, c)
            self._keys[number] = keys
            keys[:found].sort()
            return keys[:found], tally

        lists, tally = _merged(self._each(move, n))
        self._last = tally.moved + _CANDIDATE * tally.candidates
        return lists, tally

    def _wanted(self, pixels: int) -> int:
        runs = -(-pixels // RUN)
        if self._fixed:
            return min(self._fixed, runs)
        return max(1, min(self._most, runs, self._last // _WORTH_A_THREAD))

    def _reserve(self, threads: int) -> None:
        while len(self._buffers) < threads:
            self._buffers.append(Buffers(new_table(), new_subset(0), new_scratch()))
            self._keys.append(np.empty(4096, np.uint64))

    def _each(self, move: Callable[[int], tuple[_Keys, Tally]], n: int) -> list[tuple[_Keys, Tally]]:
        """Return the results of all shares; the first is this thread's."""
        if n == 1:
            return [move(0)]
        if self._pool is None:
            self._pool = ThreadPoolExecutor(max(self._most, n) - 1, thread_name_prefix="pixels")
        others = [self._pool.submit(move, number) for number in range(1, n)]
        return [move(0), *(other.result() for other in others)]


def _merged(shares: list[tuple[_Keys, Tally]]) -> tuple[list[_Keys], Tally]:
    """Return the events of all shares in at most two sorted lists, and their counts."""
    lists = [keys for keys, _ in shares]
    if len(lists) > 2:
        half = len(lists) // 2
        lists = [np.concatenate(part) for part in (lists[:half], lists[half:])]
        for part in lists:
            part.sort(kind="stable")  # merges the sorted parts
    return lists, Tally(*(sum(column) for column in zip(*(tally for _, tally in shares), strict=True)))


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
