"""The codes of what raised an event."""

from __future__ import annotations

from enum import IntEnum

__all__ = ["Origin"]


class Origin(IntEnum):
    """What raised an event.

    UNKNOWN is an event of pixels in which noise and light move one comparator (noise of the grid grade) or which follow
    another simulator's rule; SIGNAL and LEAK are told apart by the definition in `leak_share`.
    """

    UNKNOWN = 0
    SIGNAL = 1
    LEAK = 2
    NOISE = 3
    BACKGROUND = 4
    PARTICLE = 5
