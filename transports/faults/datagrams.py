"""Faults of packets in datagrams: their tables in a rig, and their effects between the endpoint and its socket.

    endpoint.send --> stage --> stage --> [datagrams for which the kernel had no room] --> socket

While no fault is active a datagram is sent directly. Each message has one fate: it has arrived when one intact copy of
it was sent, and is lost when no copy is left that could arrive.

The stages for lost, repeated and late datagrams are independent of the contents, so other transports use them too.
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
    """Datagrams that never arrive, as when a queue on the path is full."""

    kind: ClassVar[str] = "lost_datagrams"


@dataclass(frozen=True)
class RepeatedDatagrams(HitFault):
    """Datagrams that arrive twice."""

    kind: ClassVar[str] = "repeated_datagrams"


@dataclass(frozen=True)
class LateDatagrams(HitFault):
    """Datagrams that later datagrams overtake.

    Attributes
    ----------
    overtaken_by
        Number of datagrams that pass each.
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
"""Faults of packets in datagrams, by kind. Bit flips are not detected by the checksum of UDP, as in a gateway."""


T = TypeVar("T")


class DatagramStage(ABC, Generic[T]):
    """One active fault of datagrams; see `ByteStage` for the attributes."""

    def __init__(self) -> None:
        self.hits = self.touched = 0
        self.over = False

    @abstractmethod
    def change(self, datagram: T) -> list[T]:
        """Return the datagrams that are passed on now."""

    def finish(self) -> list[T]:
        """Return the datagrams that are passed on at the end of the fault."""
        return []


class _Hits(DatagramStage[T]):
    """Fault that is applied to single datagrams."""

    def __init__(self, fault: HitFault, random: np.random.Generator) -> None:
        super().__init__()
        self._where = Places(fault, random)

    def _is_hit(self) -> bool:
        hit = bool(self._where.within(1))
        self.hits += hit
        self.touched += hit
        self.over = self._where.over
        return hit


class Loss(_Hits[T]):
    """Loss of single datagrams."""

    def change(self, datagram: T) -> list[T]:
        """See `DatagramStage.change`."""
        return [] if self._is_hit() else [datagram]


class Repetition(_Hits[T]):
    """Repetition of single datagrams."""

    def change(self, datagram: T) -> list[T]:
        """See `DatagramStage.change`."""
        return [datagram, datagram] if self._is_hit() else [datagram]


class _Delay(_Hits[T]):
    """Delay of single datagrams, which others overtake."""

    def __init__(self, fault: LateDatagrams, random: np.random.Generator) -> None:
        super().__init__(fault, random)
        self._overtaken_by = fault.overtaken_by
        self._held: deque[tuple[int, T]] = deque()
        self._passed = 0

    def change(self, datagram: T) -> list[T]:
        if self._is_hit():
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
    """Return the stage of a fault; raises ValueError for a fault that datagrams do not have."""
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
    """Message in progress: the number of its copies, and if one has arrived."""

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
    """Path of datagrams with fault injection; `arrived` is called with each message that an intact receiver gets.

    Attributes
    ----------
    false
        Number of datagrams that a receiver accepts although they were not sent in this form, or were repeated.
    """

    def __init__(self, plan: FaultPlan, arrived: Callable[[Outgoing], None]) -> None:
        self._faults: Faults[DatagramStage[_Copy]] = Faults(plan, _stage)
        self._arrived = arrived
        self._waiting: deque[_Copy] = deque()
        self._number = 0
        self.false = 0

    @property
    def records(self) -> tuple[FaultRecord, ...]:
        """Record of each fault."""
        return self._faults.records

    @property
    def next_us(self) -> int:
        """See `Faults.next_us`."""
        return self._faults.next_us

    def advance(self, now_us: int) -> None:
        """Advance stream time."""
        for stage in self._faults.advance(now_us):
            self._waiting += stage.finish()

    def inject(self, fault: Fault) -> None:
        """Begin a fault now; raises ValueError for a fault that datagrams do not have."""
        self._faults.inject(fault)

    def send(self, data: bytes, outgoing: Outgoing, socket: _Send) -> bool | None:
        """Send a message through the faults.

        Returns None if the kernel has no room now and nothing was done, False if the message cannot be sent at all.
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
        """Send the waiting datagrams; return True if all of them were sent."""
        while self._waiting and self._leave(self._waiting[0], socket):
            self._waiting.popleft()
        return not self._waiting

    def close(self, socket: _Send) -> None:
        """End all faults; the datagrams that they hold are sent now, or lost."""
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
        """Pass a datagram to the kernel; return False when it has no room now."""
        try:
            left = socket(copy.data)
        except BlockingIOError:
            return False
        if left and copy.data == copy.of.data:
            self._arrive(copy.of)
        else:
            self.false += left and bool(Profile("ccsds").unwrapper().push(copy.data))
            if not left and self._faults.stages:  # attributed to the newest fault, for lack of another cause
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
