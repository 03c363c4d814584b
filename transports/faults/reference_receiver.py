"""What a sound receiver makes of a damaged line: the ground truth of what faults destroyed.

    sender --bytes or frames--> faults --+--> port or bus
           --left--> expected            +--> reader, as at the other side --> came, compared with what is expected

It listens only from a fault's beginning until whole messages come again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from firmware_protocol.instrument.outgoing import Outgoing
from firmware_protocol.packets.message import Message, Received

__all__ = ["ReferenceReceiver"]

_IN_STEP = 2  # messages in a row: of the first one, the beginning may have been damaged before


class ReferenceReceiver:
    """Tells which messages survived, in order.

    Attributes
    ----------
    false
        Messages that came and were not sent, or came again.
    """

    def __init__(self) -> None:
        self._expected: deque[Outgoing] = deque()
        self._came: deque[Message] = deque()
        self._in_step = 0
        self.false = 0

    @property
    def in_step(self) -> bool:
        """True when nothing is outstanding and messages come whole again."""
        return not self._expected and self._in_step >= _IN_STEP

    def came(self, received: Iterable[Received]) -> None:
        """Say what a sound receiver has made of what arrived."""
        self._came += [each.message for each in received]

    def left(self, outgoing: Outgoing) -> None:
        """Say that the last byte of this has left, whatever became of it."""
        self._expected.append(outgoing)

    def settle(self) -> tuple[list[Outgoing], list[Outgoing]]:
        """Return what came whole since the last call, and what is now known to be lost."""
        came: list[Outgoing] = []
        lost: list[Outgoing] = []
        while self._came:
            message = self._came.popleft()
            place = next((n for n, each in enumerate(self._expected) if _same(each.message, message)), None)
            if place is None:
                self.false += 1
                continue
            self._in_step = self._in_step + 1 if place == 0 else 1
            lost += [self._expected.popleft() for _ in range(place)]
            came.append(self._expected.popleft())
        return came, lost

    def give_up(self) -> list[Outgoing]:
        """Return what is outstanding: nothing more will come of it."""
        lost = list(self._expected)
        self._expected.clear()
        return lost

    def damaged(self) -> None:
        """A fault has been at work until now."""
        self._in_step = 0


def _same(sent: Message, came: Message) -> bool:
    return sent.kind is came.kind and sent.payload == came.payload
