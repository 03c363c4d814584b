"""What faults do to packets in datagrams, between the endpoint and its socket.

    endpoint.send --> stage --> stage --> [what the kernel had no room for] --> socket

While no fault is at work a datagram goes straight out. Each message that went in has one fate: it has arrived when one
sound copy of it left, and is lost when no copy is left that could.

The faults of packets in datagrams, as a rig writes them.

Faults at work on single datagrams, whatever carries them: lost, repeated and late ones.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Generic, TypeVar

import numpy as np

from firmware_protocol.instrument.instrument import Outgoing
from firmware_protocol.packets.profile import Profile
from transports.faults.kinds import BitFlips, Fault, HitFault, Places
from transports.faults.line import byte_stage
from transports.faults.script import FaultPlan, FaultRecord, Faults

__all__ = [
    "DATAGRAM_FAULTS",
    "DatagramStage",
    "FaultyDatagrams",
    "LateDatagrams",
    "Loss",
    "LostDatagrams",
    "RepeatedDatagrams",
    "Repetition",
    "datagram_stage",
]


@dataclass(frozen=True)
class LostDatagrams(HitFault):
    """Datagrams that never arrive, as where a queue on the way is full."""

    kind: ClassVar[str] = "lost_datagrams"


@dataclass(frozen=True)
class RepeatedDatagrams(HitFault):
    """Datagrams that arrive twice."""

    kind: ClassVar[str] = "repeated_datagrams"


@dataclass(frozen=True)
class LateDatagrams(HitFault):
    """Datagrams that others overtake.

    Attributes
    ----------
    overtaken_by
        How many others pass each.
    """

    kind: ClassVar[str] = "late_datagrams"
    overtaken_by: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.overtaken_by <= 1000:
            raise ValueError(f"overtaken_by must be 1 to 1000 datagrams, got {self.overtaken_by}")


DATAGRAM_FAULTS: Mapping[str, type[Fault]] = {
    each.kind: each for each in (LostDatagrams, RepeatedDatagrams, LateDatagrams, BitFlips)
}
"""Faults of packets in datagrams, by kind. Bits flip where no checksum of UDP sees it, as in a gateway."""


T = TypeVar("T")


class DatagramStage(ABC, Generic[T]):
    """One fault at work on datagrams; see `ByteStage` for the attributes."""

    def __init__(self) -> None:
        self.hits = self.touched = 0
        self.over = False

    @abstractmethod
    def change(self, datagram: T) -> list[T]:
        """Return what goes on now."""

    def finish(self) -> list[T]:
        """Return what goes on when the fault is over."""
        return []


class _Hits(DatagramStage[T]):
    """Strikes single datagrams."""

    def __init__(self, fault: HitFault, random: np.random.Generator) -> None:
        super().__init__()
        self._where = Places(fault, random)

    def _struck(self) -> bool:
        struck = bool(self._where.within(1))
        self.hits += struck
        self.touched += struck
        self.over = self._where.over
        return struck


class Loss(_Hits[T]):
    """Lets single datagrams go."""

    def change(self, datagram: T) -> list[T]:
        """See `DatagramStage.change`."""
        return [] if self._struck() else [datagram]


class Repetition(_Hits[T]):
    """Sends single datagrams twice."""

    def change(self, datagram: T) -> list[T]:
        """See `DatagramStage.change`."""
        return [datagram, datagram] if self._struck() else [datagram]


class _Delay(_Hits[T]):
    """Lets others overtake single datagrams."""

    def __init__(self, fault: LateDatagrams, random: np.random.Generator) -> None:
        super().__init__(fault, random)
        self._overtaken_by = fault.overtaken_by
        self._held: deque[tuple[int, T]] = deque()
        self._passed = 0

    def change(self, datagram: T) -> list[T]:
        if self._struck():
            self._held.append((self._passed + self._overtaken_by, datagram))
            self.over = False
            return []
        self._passed += 1
        going = [datagram]
        while self._held and self._held[0][0] <= self._passed:
            going.append(self._held.popleft()[1])
        self.over = self._where.over and not self._held
        return going

    def finish(self) -> list[T]:
        held, self._held = [datagram for _, datagram in self._held], deque()
        return held


def datagram_stage(fault: Fault, random: np.random.Generator) -> DatagramStage[T]:
    """Return a fault at work; raises ValueError for one that datagrams do not have."""
    match fault:
        case LostDatagrams():
            return Loss(fault, random)
        case RepeatedDatagrams():
            return Repetition(fault, random)
        case LateDatagrams():
            return _Delay(fault, random)
    raise ValueError(f"{fault.kind!r} is no fault of packets in datagrams")


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
                self._faults.applied(stage, [self._number])
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
                self._faults.applied(self._faults.stages[-1], [])
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
