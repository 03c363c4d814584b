"""Bytes on their way into a serial port: pulled as late as possible, released at the baud rate, never waiting.

    source --frames--> [ f f f | part of f ] --bytes that are due--> port.write

A frame is pulled when the line would otherwise run dry before the next tick. What the port does not take stays here and
is counted as held; the line then stands still, as one with hardware flow control does.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from transports.serial_line.pacing import BaudClock

__all__ = ["Frame", "Transmitter"]

_Tag = TypeVar("_Tag")


@dataclass(frozen=True)
class Frame(Generic[_Tag]):
    """Bytes that go together, and what they stand for."""

    data: bytes
    tag: _Tag


class Transmitter(Generic[_Tag]):
    """Sends frames through `write`, which returns how many of the bytes it took.

    Parameters
    ----------
    pull
        Gives the next frame, or None when there is nothing to say.
    left
        Is told of each frame whose last byte has left.
    ahead_ns
        How long before the line falls silent the next frame is pulled: a little more than a tick.
    """

    def __init__(
        self,
        clock: BaudClock,
        pull: Callable[[], Frame[_Tag] | None],
        left: Callable[[_Tag], None],
        ahead_ns: int,
    ) -> None:
        self._clock = clock
        self._pull = pull
        self._left = left
        self._ahead_ns = ahead_ns
        self._frames: deque[Frame[_Tag]] = deque()
        self._gone = 0  # bytes of the first frame that have left
        self._waiting = 0
        self.held = 0

    @property
    def waiting(self) -> int:
        """Bytes that have been pulled and not sent."""
        return self._waiting

    @property
    def begun(self) -> bytes:
        """What has left of the frame that is on the line."""
        return self._frames[0].data[: self._gone] if self._frames else b""

    def pump(self, write: Callable[[bytes], int], now_ns: int) -> None:
        """Send what is due, and pull what will be next."""
        while self._fill(now_ns):
            due = self._clock.due(now_ns)
            if not due:
                return
            if not self._send(write, due, now_ns):
                return

    def drop(self) -> list[_Tag]:
        """Forget all frames, the one on the line too, and return what they stand for."""
        tags = [frame.tag for frame in self._frames]
        self._frames.clear()
        self._gone = self._waiting = 0
        return tags

    def _fill(self, now_ns: int) -> bool:
        """Pull until the line has enough for the time to come; say whether there is anything to send."""
        while self._clock.free_ns() + self._clock.duration_ns(self._waiting) < now_ns + self._ahead_ns:
            frame = self._pull()
            if frame is None:
                break
            self._frames.append(frame)
            self._waiting += len(frame.data)
        if not self._frames:
            self._clock.restart(now_ns)
        return bool(self._frames)

    def _send(self, write: Callable[[bytes], int], due: int, now_ns: int) -> bool:
        """Write up to `due` bytes; say whether the port took them all."""
        data = self._next_bytes(due)
        taken = write(data)
        self._clock.leave(taken, now_ns)
        self._waiting -= taken
        self._gone += taken
        while self._frames and self._gone >= len(self._frames[0].data):
            frame = self._frames.popleft()
            self._gone -= len(frame.data)
            self._left(frame.tag)
        if taken < len(data):
            self.held += 1
            self._clock.restart(now_ns)
            return False
        return True

    def _next_bytes(self, count: int) -> bytes:
        parts, have = [], -self._gone
        for frame in self._frames:
            parts.append(frame.data)
            have += len(frame.data)
            if have >= count:
                break
        return b"".join(parts)[self._gone : self._gone + count]
