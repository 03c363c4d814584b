"""What became of blocks that were sent, when faults on the way took packets from them and hosts asked for these again.

    block left --> whole? --> arrived, in order
                   packets missing --> sent again in time --> arrived
                                       not ---------------> destroyed by the fault

A host gets blocks in order: those behind a block with missing packets wait for its fate.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from firmware_protocol.gige.outflow import Outgoing

__all__ = ["BlockFates"]

_PATIENCE_NS = 200_000_000  # Aravis gives a block up 100 ms after its last packet


@dataclass
class _Left:
    outgoing: Outgoing
    at_ns: int
    missing: set[int] = field(default_factory=set)


class BlockFates:
    """Tells `arrived` and `destroyed` of each block once, in the order in which they left."""

    def __init__(self, arrived: Callable[[Outgoing], None], destroyed: Callable[[Outgoing], None]) -> None:
        self._arrived = arrived
        self._destroyed = destroyed
        self._waiting: deque[_Left] = deque()
        self._missing: dict[int, set[int]] = {}

    def missed(self, block: int, packet: int) -> None:
        """Say that a packet was taken away, before or after its block has left."""
        self._missing.setdefault(block, set()).add(packet)

    def came(self, block: int, packet: int) -> None:
        """Say that a packet arrived after all."""
        self._missing.get(block, set()).discard(packet)

    def left(self, outgoing: Outgoing, now_ns: int) -> None:
        """Say that all packets of a block have left the camera."""
        missing = self._missing.get(outgoing.block.number)
        if not missing and not self._waiting:
            self._arrived(outgoing)
        else:
            self._waiting.append(_Left(outgoing, now_ns, missing or set()))

    def settle(self, now_ns: int, *, final: bool = False) -> None:
        """Tell the fates that are known by now; at the end, all of them."""
        while self._waiting:
            first = self._waiting[0]
            if first.missing and not final and now_ns - first.at_ns < _PATIENCE_NS:
                return
            self._waiting.popleft()
            self._missing.pop(first.outgoing.block.number, None)
            (self._destroyed if first.missing else self._arrived)(first.outgoing)
