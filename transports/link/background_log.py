"""Text output that never blocks its writer: a bounded queue and a thread in front of a file descriptor.

A pipe without a reader takes 64 KiB and then blocks its writer. A camera must not stop for that, so log lines and the
live table are written through this queue. Text that does not fit into the queue is dropped and counted.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from contextlib import suppress

_CAPACITY_BYTES = 1 << 20
_CLOSE_TIMEOUT_S = 1.0


class BackgroundWriter:
    """Text file that writes to `descriptor` from a thread; `dropped_bytes`: those that found the queue full."""

    encoding = "utf-8"

    def __init__(self, descriptor: int, capacity_bytes: int = _CAPACITY_BYTES) -> None:
        self._descriptor = descriptor
        self._capacity_bytes = capacity_bytes
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self.dropped_bytes = 0

    def write(self, text: str) -> int:
        """Queue `text`, or drop it when the queue is full; return its length."""
        data = text.encode(errors="replace")
        with self._changed:
            if self._waiting_bytes + len(data) > self._capacity_bytes:
                self.dropped_bytes += len(data)
                return len(text)
            self._waiting.append(data)
            self._waiting_bytes += len(data)
            if self._thread is None:
                # A daemon: the process must be able to end while a write to a full pipe blocks this thread.
                self._thread = threading.Thread(target=self._write_all, name="background log", daemon=True)
                self._thread.start()
            self._changed.notify_all()
        return len(text)

    def flush(self) -> None:
        """Do nothing: waiting here would be the block that this class avoids."""

    def drain(self, timeout_s: float = _CLOSE_TIMEOUT_S) -> bool:
        """Wait until everything is written, for at most `timeout_s`; return whether it is."""
        deadline_s = time.monotonic() + timeout_s
        with self._changed:
            return self._changed.wait_for(lambda: not self._waiting_bytes, max(0.0, deadline_s - time.monotonic()))

    def isatty(self) -> bool:
        """Return True if the output is a terminal."""
        return os.isatty(self._descriptor)

    def fileno(self) -> int:
        """Return the file descriptor behind the queue."""
        return self._descriptor

    def _write_all(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting)
                left = data = b"".join(self._waiting)
                self._waiting.clear()
            with suppress(OSError):  # the reader has closed the pipe: no error can be reported
                while left:
                    left = left[os.write(self._descriptor, left) :]
            with self._changed:
                self._waiting_bytes -= len(data)
                self._changed.notify_all()


def log_in_background(level: int = logging.WARNING) -> BackgroundWriter:
    """Send this process's log to stderr through a BackgroundWriter; for link processes."""
    writer = BackgroundWriter(2)
    logging.basicConfig(level=level, format="%(message)s", handlers=[logging.StreamHandler(writer)], force=True)
    return writer
