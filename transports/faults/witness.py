"""What a sound receiver makes of a damaged line: the ground truth of what faults destroyed.

    transmitter --bytes--> faults --bytes--+--> port
                --left---> expected        +--> unwrapper, as at the other side: what came, compared with what was sent

It listens only from a fault's beginning until whole messages come again.
"""

from __future__ import annotations

from collections import deque

from firmware_protocol.instrument.outgoing import Outgoing
from firmware_protocol.packets.message import Message
from firmware_protocol.packets.profile import Profile

__all__ = ["Witness"]

_IN_STEP = 2  # messages in a row: of the first one, the beginning may have been damaged before


class Witness:
    """Tells which messages survived, in order.

    Attributes
    ----------
    false
        Messages that came and were never sent: none, or the packets' checks are too weak.
    """

    def __init__(self, profile: str) -> None:
        self._unwrapper = Profile(profile).unwrapper()
        self._expected: deque[Outgoing] = deque()
        self._came: deque[Message] = deque()
        self._in_step = 0
        self.false = 0

    @property
    def in_step(self) -> bool:
        """True when nothing is outstanding and messages come whole again."""
        return not self._expected and self._in_step >= _IN_STEP

    def push(self, data: bytes) -> None:
        """Take bytes as they arrive."""
        self._came += [received.message for received in self._unwrapper.push(data)]

    def left(self, outgoing: Outgoing) -> None:
        """Say that the last byte of this has left, whatever became of it; its bytes have been pushed."""
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
        """A fault has struck again."""
        self._in_step = 0


def _same(sent: Message, came: Message) -> bool:
    return sent.kind is came.kind and sent.payload == came.payload
