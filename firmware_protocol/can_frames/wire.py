"""A CAN bus as a wire: one frame at a time, the lowest identifier first, each as long as its bits take.

Each node offers frames in order and competes with its first one, as a controller with one transmit buffer does. A frame
that has begun is never interrupted. What is not modelled: errors, acknowledgement, propagation.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from firmware_protocol.can_frames.bus_time import BitRates, frame_bits
from firmware_protocol.can_frames.frame import Frame

__all__ = ["Carried", "Wire"]


@dataclass(frozen=True)
class Carried:
    """A frame that has gone over the wire: who sent it, and when its first bit began and its last one ended."""

    frame: Frame
    node: int
    begin_ns: int
    end_ns: int


class Wire:
    """The bus. Time is the caller's, never goes back, and has to be moved on by `advance`."""

    def __init__(self, rates: BitRates) -> None:
        self._rates = rates
        self._queues: dict[int, deque[tuple[int, Frame]]] = {}
        self._free_ns = 0
        self._current: Carried | None = None
        self.busy_ns = 0

    def waiting(self, node: int) -> int:
        """Return how many frames of a node have not begun."""
        return len(self._queues.get(node, ()))

    @property
    def busy(self) -> bool:
        """True while a frame has begun whose last bit has not passed."""
        return self._current is not None

    def offer(self, node: int, frame: Frame, now_ns: int) -> None:
        """A node wants to send a frame, at the latest time given to `advance` or later."""
        self._queues.setdefault(node, deque()).append((now_ns, frame))

    def forget(self, node: int) -> None:
        """A node has left: what it has not begun to send is gone."""
        self._queues.pop(node, None)

    def advance(self, now_ns: int) -> list[Carried]:
        """Let time pass; returns the frames whose last bit has passed by `now_ns`."""
        done: list[Carried] = []
        while True:
            if self._current is None:
                self._current = self._begin(now_ns)
            if self._current is None or self._current.end_ns > now_ns:
                return done
            done.append(self._current)
            self._free_ns = self._current.end_ns
            self._current = None

    def _begin(self, now_ns: int) -> Carried | None:
        """Let the nodes' first frames compete for the next moment at which the bus is free and one is there."""
        heads = {node: queue[0] for node, queue in self._queues.items() if queue}
        if not heads:
            return None
        begin_ns = max(self._free_ns, min(offered for offered, _ in heads.values()))
        if begin_ns > now_ns:
            return None
        node = min((n for n in heads if heads[n][0] <= begin_ns), key=lambda n: (heads[n][1].arbitration, heads[n][0]))
        _, frame = self._queues[node].popleft()
        duration_ns = self._rates.duration_ns(frame_bits(frame))
        self.busy_ns += duration_ns
        return Carried(frame, node, begin_ns, begin_ns + duration_ns)
