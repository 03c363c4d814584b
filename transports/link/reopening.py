"""Attempts to open again what was lost: one at a time, a period apart, by a clock that is passed in."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, Generic, TypeVar

from transports.link.pacing import Clock

__all__ = ["Reopening"]

T = TypeVar("T")


class Reopening(Generic[T]):
    """Opens a port or a bus again, beside the link's ticks.

    Parameters
    ----------
    attempt
        Opens it and returns what was opened; an exception means that this attempt failed.
    period_ns
        From a loss, or from the end of an attempt that failed, to the next attempt.

    Attributes
    ----------
    why
        What the last attempt that failed said.
    """

    def __init__(self, clock: Clock, period_ns: int, attempt: Callable[[], Coroutine[Any, Any, T]]) -> None:
        self._clock = clock
        self._period_ns = period_ns
        self._attempt = attempt
        self._next_ns = 0
        self._running: asyncio.Task[T] | None = None
        self.why = ""

    def lost(self, why: str = "") -> None:
        """Say that it was lost just now."""
        self.why = why
        self._next_ns = self._clock.now_ns() + self._period_ns

    def poll(self) -> T | None:
        """Return what was opened since the last call, or None; starts an attempt when one is due."""
        if self._running is None:
            if self._clock.now_ns() >= self._next_ns:
                self._running = asyncio.get_running_loop().create_task(self._attempt())
            return None
        if not self._running.done():
            return None
        done, self._running = self._running, None
        failure = done.exception()
        if failure is None:
            return done.result()
        self.lost(str(failure))
        return None

    async def close(self) -> None:
        """Give up the attempt under way."""
        if self._running is not None:
            self._running.cancel()
            await asyncio.gather(self._running, return_exceptions=True)
