"""The number of threads for a part of a run, and a pool of threads that share work.

Drawing and pixels follow one rule, because they run in turns.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

MOST_THREADS = 4
"""More give no gain: memory, not arithmetic, is then the limit."""


def available_threads() -> int:
    """Return the number of threads for large work: the cores of this process, at most MOST_THREADS."""
    return min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, MOST_THREADS)


class ThreadPool:
    """Threads that share work; the caller's thread is one of these `threads`. Not for several callers at a time."""

    def __init__(self, threads: int) -> None:
        self.threads = max(threads, 1)
        self._pool = ThreadPoolExecutor(self.threads - 1) if self.threads > 1 else None

    def __reduce__(self) -> tuple[Any, ...]:
        """Let a copy of an object that uses it have as many threads of its own."""
        return ThreadPool, (self.threads,)

    def each(self, work: Callable[[int, int], object], count: int) -> None:
        """Call work(item, thread) for items 0 to count - 1, each once, in any order; an error of one is raised."""
        left = itertools.count()  # its next() is one step for the interpreter, so no item is taken twice

        def take(thread: int) -> None:
            while (item := next(left)) < count:
                work(item, thread)

        helpers = range(1, min(self.threads, count))
        tasks = [self._pool.submit(take, thread) for thread in helpers] if self._pool else []
        try:
            take(0)
        finally:
            errors = [task.exception() for task in tasks if not task.cancel()]  # no wait for one that has not begun
        for error in errors:
            if error is not None:
                raise error

    def close(self) -> None:
        """End the threads; a second call does nothing."""
        if self._pool is not None:
            self._pool.shutdown()
