"""Bounded queue of messages for a pipe, so that a slow reader at its far end delays no camera.

put --> queue --> send_all, in a thread of its own --> pipe
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Sequence

__all__ = ["PipeQueue"]


class PipeQueue:
    """Messages that wait for a pipe.

    Parameters
    ----------
    capacity_bytes
        Size of the messages that may wait.

    Attributes
    ----------
    waiting_bytes
        Size of those that wait now, or are being sent.
    broken
        True when nothing can be sent any more.
    """

    def __init__(self, capacity_bytes: int) -> None:
        self._capacity_bytes = capacity_bytes
        self._waiting: deque[bytes] = deque()
        self._changed = threading.Condition()
        self._ended = False
        self.waiting_bytes = 0
        self.broken = False

    @property
    def room_bytes(self) -> int:
        """Size of the messages that `put` takes now."""
        return 0 if self.broken else max(0, self._capacity_bytes - self.waiting_bytes)

    def put(self, messages: Sequence[bytes], *, wait: bool) -> bool:
        """Queue messages, all or none; False where there is no room, or, with `wait`, where the pipe is broken."""
        size = sum(len(message) for message in messages)
        with self._changed:
            if wait:
                self._changed.wait_for(lambda: self.broken or size <= self.room_bytes)
            if size > self.room_bytes or self.broken:
                return False
            self._waiting.extend(messages)
            self.waiting_bytes += size
            self._changed.notify_all()
        return True

    def end(self) -> None:
        """Let `send_all` return when all has been sent."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def stop(self) -> None:
        """Refuse every further message."""
        with self._changed:
            self.broken = True
            self._changed.notify_all()

    def send_all(self, descriptor: int) -> None:
        """Write messages as they come, until `end`, or until the far end of the pipe is closed."""
        try:
            while data := self._next():
                _write(descriptor, data)
                with self._changed:
                    self.waiting_bytes -= len(data)
                    self._changed.notify_all()
        except OSError:  # the reader has ended
            self.stop()

    def _next(self) -> bytes:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._ended)
            data = b"".join(self._waiting)
            self._waiting.clear()
            return data


def _write(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]
