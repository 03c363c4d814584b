"""What faults do to packets in datagrams, between the endpoint and its socket.

    endpoint.send --> stage --> stage --> [what the kernel had no room for] --> socket

While no fault is at work a datagram goes straight out. Each message that went in has one fate: it has arrived when one
sound copy of it left, and is lost when no copy is left that could.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from firmware_protocol.instrument.outgoing import Outgoing
from firmware_protocol.packets.profile import Profile
from transports.faults.datagram_stages import DatagramStage, Loss, Repetition, datagram_stage
from transports.faults.kinds import BitFlips, Fault
from transports.faults.line import byte_stage
from transports.faults.script import FaultPlan, FaultRecord, Faults

__all__ = ["FaultyDatagrams"]

_Send = Callable[[bytes], bool]


@dataclass
class _Sent:
    """A message on its way: how many copies of it there are, and whether one has arrived."""

    data: bytes
    outgoing: Outgoing
    copies: int = 1
    arrived: bool = False


@dataclass(frozen=True)
class _Copy:
    data: bytes
    of: _Sent


class _Flips(DatagramStage[_Copy]):
    def __init__(self, fault: BitFlips, random: np.random.Generator) -> None:
        super().__init__()
        self._bits = byte_stage(fault, random, 1.0)

    def change(self, copy: _Copy) -> list[_Copy]:
        data = self._bits.change(copy.data)
        self.hits, self.touched, self.over = self._bits.hits, self._bits.touched, self._bits.over
        return [_Copy(data, copy.of)]


def _stage(fault: Fault, random: np.random.Generator) -> DatagramStage[_Copy]:
    return _Flips(fault, random) if isinstance(fault, BitFlips) else datagram_stage(fault, random)


class FaultyDatagrams:
    """A way for datagrams on which faults happen; `arrived` is told of each message that a sound receiver gets.

    Attributes
    ----------
    false
        Datagrams that a receiver takes and that were not sent so, or that came again.
    """

    def __init__(self, plan: FaultPlan, arrived: Callable[[Outgoing], None]) -> None:
        self._faults: Faults[DatagramStage[_Copy]] = Faults(plan, _stage)
        self._arrived = arrived
        self._waiting: deque[_Copy] = deque()
        self._number = 0
        self.false = 0

    @property
    def records(self) -> tuple[FaultRecord, ...]:
        """What each fault has done."""
        return self._faults.records

    def advance(self, now_us: int) -> None:
        """Let stream time pass."""
        for stage in self._faults.advance(now_us):
            self._waiting += stage.finish()

    def inject(self, fault: Fault) -> None:
        """Begin a fault now; raises ValueError for one that datagrams do not have."""
        self._faults.inject(fault)

    def send(self, data: bytes, outgoing: Outgoing, socket: _Send) -> bool | None:
        """Send a message by way of the faults.

        Returns None where the kernel has no room now and nothing was done, False where it cannot be sent at all.
        """
        if not self.flush(socket):
            return None
        if not self._faults.stages:
            return self._straight(data, outgoing, socket)
        self._waiting += self._changed(_Copy(data, _Sent(data, outgoing)))
        self._number += 1
        self.flush(socket)
        return True

    def _straight(self, data: bytes, outgoing: Outgoing, socket: _Send) -> bool | None:
        try:
            left = socket(data)
        except BlockingIOError:
            return None
        if left:
            self._arrived(outgoing)
        return left

    def flush(self, socket: _Send) -> bool:
        """Send what waits here; say whether all of it has left."""
        while self._waiting and self._leave(self._waiting[0], socket):
            self._waiting.popleft()
        return not self._waiting

    def close(self, socket: _Send) -> None:
        """End all faults; what they hold goes out now, or is lost."""
        for stage in self._faults.stages:
            self._waiting += stage.finish()
        if not self.flush(socket):
            for copy in self._waiting:
                self._drop(copy)
        self._faults.close()

    def _changed(self, copy: _Copy) -> list[_Copy]:
        copies = [copy]
        for stage in self._faults.stages:
            before, gone, going = stage.hits, list[_Copy](), list[_Copy]()
            for each in copies:
                passed = stage.change(each)
                each.of.copies += isinstance(stage, Repetition) and len(passed) - 1
                going += passed
                gone += [each] if not passed and isinstance(stage, Loss) else []
            if stage.hits != before:
                self._faults.struck(stage, [self._number])
            for each in gone:
                self._drop(each)
            copies = going
        return copies

    def _leave(self, copy: _Copy, socket: _Send) -> bool:
        """Give the kernel a datagram; False when it has no room now."""
        try:
            left = socket(copy.data)
        except BlockingIOError:
            return False
        if left and copy.data == copy.of.data:
            self._arrive(copy.of)
        else:
            self.false += left and bool(Profile("ccsds").unwrapper().push(copy.data))
            if not left and self._faults.stages:  # what nobody else is to blame for
                self._faults.struck(self._faults.stages[-1], [])
            self._drop(copy)
        return True

    def _arrive(self, sent: _Sent) -> None:
        if sent.arrived:
            self.false += 1
        else:
            sent.arrived = True
            self._arrived(sent.outgoing)

    def _drop(self, copy: _Copy) -> None:
        copy.of.copies -= 1
        if not copy.of.copies and not copy.of.arrived:
            self._lose(copy.of)

    def _lose(self, sent: _Sent) -> None:
        self._faults.lose(len(sent.outgoing.events), len(sent.outgoing.edges))
