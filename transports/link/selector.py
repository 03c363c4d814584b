"""A selector with epoll's reach and select's resolution.

`select` fails above 1023 file descriptors, and epoll waits for whole milliseconds only, which would double a tick of
half a millisecond. An epoll set is itself a file descriptor with a low number: `select` waits for that one.
"""

from __future__ import annotations

import select
import selectors

__all__ = ["FineSelector"]


class FineSelector(selectors.DefaultSelector):
    """The best selector of the machine (epoll, kqueue), which wakes up within microseconds of its deadline."""

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return what is ready, at the latest after `timeout` seconds."""
        if timeout is None or timeout > 0:
            select.select([self.fileno()], [], [], timeout)
        return super().select(0)
