"""The browsers that look at a run. What one does not read in time is replaced by what is newer, and never kept.

A viewer says which message it has shown last; at most three are on their way to it. So a slow viewer or network
gets fewer pictures, and one that stops reading has at most three of them in the machine's buffers until it is dropped.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable

from emulator.live_page.messages import BadMessage

__all__ = ["MOST_VIEWERS", "Viewer", "Viewers"]

MOST_VIEWERS = 16
STALLED_S = 10.0

_MOST_ON_THE_WAY = 3
_MOST_ANSWERS = 16
_MESSAGES_PER_S, _MOST_AT_ONCE = 100.0, 200.0


class Viewer:
    """One browser.

    Parameters
    ----------
    now_s
        A clock, s.

    Attributes
    ----------
    number
        Which; answers are for one viewer alone.
    """

    def __init__(self, number: int, now_s: Callable[[], float]) -> None:
        self.number = number
        self._now_s = now_s
        self._status: str | None = None
        self._picture: bytes | None = None
        self._answers: deque[str] = deque(maxlen=_MOST_ANSWERS)
        self._sent = self._seen = 0
        self._moved_s = self._filled_s = now_s()
        self._tokens = _MOST_AT_ONCE
        self._ready = asyncio.Event()

    @property
    def on_the_way(self) -> int:
        """Messages sent and not yet shown."""
        return self._sent - self._seen

    @property
    def stalled(self) -> bool:
        """Whether it has shown nothing of what was sent for so long that it is to be dropped."""
        return self.on_the_way >= _MOST_ON_THE_WAY and self._now_s() - self._moved_s > STALLED_S

    def put(self, message: str | bytes) -> None:
        """Let a status (str) or a picture (bytes) be sent next, in place of an older one that was not."""
        if isinstance(message, bytes):
            self._picture = message
        else:
            self._status = message
        self._look()

    def answer(self, message: str) -> None:
        """Let an answer be sent; of very many the oldest are left out."""
        self._answers.append(message)
        self._look()

    def has_seen(self, number: int) -> None:
        """Take note of the newest message that was shown, counted from 1; raises BadMessage."""
        if not self._seen <= number <= self._sent:
            raise BadMessage(f"message {number} has not been sent, or had been seen before")
        self._seen, self._moved_s = number, self._now_s()
        self._look()

    def charge(self) -> None:
        """Count a message that came; raises BadMessage when there are too many."""
        now_s = self._now_s()
        self._tokens = min(_MOST_AT_ONCE, self._tokens + (now_s - self._filled_s) * _MESSAGES_PER_S) - 1
        self._filled_s = now_s
        if self._tokens < 0:
            raise BadMessage("too many messages")

    async def next(self) -> str | bytes:
        """Wait until there is something to send that the viewer can take, and return it."""
        while (message := self.take()) is None:
            await self._ready.wait()
        return message

    def take(self) -> str | bytes | None:
        """Return what is to be sent now; None where that is nothing."""
        if not self._ready.is_set():
            return None
        if not self.on_the_way:
            self._moved_s = self._now_s()
        self._sent += 1
        message = self._newest()
        self._look()
        return message

    def _newest(self) -> str | bytes | None:
        if self._answers:
            return self._answers.popleft()
        message: str | bytes | None
        if self._status is not None:
            message, self._status = self._status, None
        else:
            message, self._picture = self._picture, None
        return message

    def _look(self) -> None:
        waits = self._answers or self._status is not None or self._picture is not None
        if waits and self.on_the_way < _MOST_ON_THE_WAY:
            self._ready.set()
        else:
            self._ready.clear()


class Viewers:
    """All viewers, at most `MOST_VIEWERS`."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._viewers: dict[int, tuple[Viewer, Callable[[], None]]] = {}
        self._number = 0

    def __len__(self) -> int:
        return len(self._viewers)

    def enter(self, drop: Callable[[], None]) -> Viewer | None:
        """Let a viewer in, whose connection `drop` ends at once; None where there are too many."""
        if len(self._viewers) >= MOST_VIEWERS:
            return None
        self._number += 1
        viewer = Viewer(self._number, self._now_s)
        self._viewers[viewer.number] = viewer, drop
        return viewer

    def leave(self, viewer: Viewer) -> None:
        """Forget a viewer."""
        self._viewers.pop(viewer.number, None)

    def put(self, message: str | bytes) -> None:
        """Send a status or a picture to all."""
        for viewer, _ in self._viewers.values():
            viewer.put(message)

    def tell(self, message: str) -> None:
        """Send a message to all that none may miss."""
        for viewer, _ in self._viewers.values():
            viewer.answer(message)

    def answer(self, number: int, message: str) -> None:
        """Send an answer to the one viewer that asked, if it is still there."""
        if number in self._viewers:
            self._viewers[number][0].answer(message)

    def drop_stalled(self) -> None:
        """End the connections of those that do not read."""
        for viewer, drop in list(self._viewers.values()):
            if viewer.stalled:
                self.leave(viewer)
                drop()
