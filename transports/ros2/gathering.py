"""Events that wait for others of their message."""

from __future__ import annotations

import numpy as np

from firmware_protocol.plain_device import Taken

__all__ = ["Gathering"]


class Gathering:
    """Joins what is taken from a device until there is enough, or the first has waited `longest_ns`.

    Parameters
    ----------
    most_events
        After which a message is full.
    """

    def __init__(self, most_events: int, longest_ns: int) -> None:
        self._most, self._longest_ns = most_events, longest_ns
        self._parts: list[Taken] = []
        self._since_ns = 0

    @property
    def room(self) -> int:
        """Events that still fit."""
        return self._most - sum(len(part.events) for part in self._parts)

    @property
    def holds(self) -> bool:
        """Whether something waits here."""
        return bool(self._parts)

    def add(self, taken: Taken, now_ns: int) -> None:
        """Take a part, of the same clock as those before."""
        if not self._parts:
            self._since_ns = now_ns
        self._parts.append(taken)

    def fits(self, epoch_us: int) -> bool:
        """Say whether a part of a clock that was zero at `epoch_us` may join."""
        return not self._parts or self._parts[0].epoch_us == epoch_us

    def due(self, now_ns: int) -> bool:
        """Say whether what is here is to leave now."""
        return bool(self._parts) and (self.room <= 0 or now_ns - self._since_ns >= self._longest_ns)

    def taken(self) -> Taken | None:
        """Return all that is here, and forget it; None where nothing is."""
        if not self._parts:
            return None
        parts, self._parts = self._parts, []
        events = np.concatenate([part.events for part in parts])
        edges = np.concatenate([part.edges for part in parts])
        return Taken(events, edges, parts[0].epoch_us)
