"""Faults at work on single datagrams, whatever carries them: lost, repeated and late ones."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from typing import Generic, TypeVar

import numpy as np

from transports.faults.datagram_kinds import LateDatagrams, LostDatagrams, RepeatedDatagrams
from transports.faults.hit_places import Places
from transports.faults.kinds import Fault, HitFault

__all__ = ["DatagramStage", "Loss", "Repetition", "datagram_stage"]

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
