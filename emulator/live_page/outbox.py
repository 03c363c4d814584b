"""What the session tells the page's process: sent when the pipe takes it, so that a page that hangs holds up nothing.

Answers and states are kept in their order, a bounded number of them; of statuses only the newest is.
"""

from __future__ import annotations

import select
from collections import deque
from multiprocessing.connection import Connection
from typing import Any

__all__ = ["Outbox"]

_MOST_WAITING = 64


class Outbox:
    """Messages on their way into `pipe`, which is a socket: ready when most of its buffer is free."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._kept: deque[dict[str, Any]] = deque(maxlen=_MOST_WAITING)
        self._status: dict[str, Any] | None = None
        self._writable = select.poll()
        self._writable.register(pipe.fileno(), select.POLLOUT)

    @property
    def waits(self) -> bool:
        """Whether something has not been sent."""
        return bool(self._kept) or self._status is not None

    def put(self, message: dict[str, Any]) -> None:
        """Let a message be sent in its turn; of very many that wait the oldest is left out."""
        self._kept.append(message)

    def renew(self, status: dict[str, Any]) -> None:
        """Let a status be sent, in place of an older one that was not."""
        self._status = status

    def flush(self, heard: int) -> None:
        """Send what the pipe takes, with the number of commands heard so far; raises OSError where nobody reads."""
        while self.waits and self._writable.poll(0):
            self._pipe.send({**self._next(), "heard": heard})

    def _next(self) -> dict[str, Any]:
        if self._kept:
            return self._kept.popleft()
        assert self._status is not None
        status, self._status = self._status, None
        return status
