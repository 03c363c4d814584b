"""How many messages may be under way where none is to be lost."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["Window"]

_STALLED_NS = 2_000_000_000


class Window:
    """Lets `size` messages go until all are acknowledged; readers that do not for two seconds are not waited for."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._under_way = 0
        self._since_ns: int | None = None
        self._stalled = False

    def written(self) -> None:
        """A message went."""
        self._under_way += 1

    def open(self, now_ns: int, acknowledged: Callable[[], bool]) -> bool:
        """Say whether the next one may go."""
        if self._under_way < self._size and not self._stalled:
            return True
        if acknowledged():
            self._under_way, self._since_ns, self._stalled = 0, None, False
            return True
        if self._since_ns is None:
            self._since_ns = now_ns
        self._stalled = now_ns - self._since_ns > _STALLED_NS
        return self._stalled
