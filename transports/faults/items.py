"""Faults of single items, which are frames of a bus or datagrams: the stages that do not depend on their contents.

`pass_through` is the path of one item through all active faults.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np

from transports.faults.kinds import HitFault, Places, Stage
from transports.faults.script import Faults

T = TypeVar("T")


class ItemStage(Stage, Generic[T]):
    """One active fault of items; the base class passes them unchanged."""

    def change(self, item: T) -> list[T]:
        """Return the items that are passed on now."""
        return [item]

    def finish(self) -> list[T]:
        """Return the items that are passed on at the end of the fault."""
        return []


class HitStage(ItemStage[T]):
    """Fault that is applied to each item that is hit."""

    def __init__(self, fault: HitFault, random: np.random.Generator, carrier: Any = None) -> None:
        super().__init__(fault, random, carrier)
        self._where = Places(fault, random)

    def is_hit(self) -> bool:
        """Return whether the next item is hit, and count it."""
        hit = bool(self._where.within(1))
        self.count(hit, hit)
        self.over = self._where.over
        return hit


class Loss(HitStage[T]):
    """Loss of single items."""

    def change(self, item: T) -> list[T]:
        """See `ItemStage.change`."""
        return [] if self.is_hit() else [item]


class Repetition(HitStage[T]):
    """Repetition of single items."""

    def change(self, item: T) -> list[T]:
        """See `ItemStage.change`."""
        return [item, item] if self.is_hit() else [item]


class Delay(HitStage[T]):
    """Delay of single items, each until `overtaken_by` others have passed."""

    def __init__(self, fault: HitFault, random: np.random.Generator, overtaken_by: int) -> None:
        super().__init__(fault, random)
        self._overtaken_by = overtaken_by
        self._held: deque[tuple[int, T]] = deque()  # each with the count of passed items at which it follows
        self._passed = 0

    def change(self, item: T) -> list[T]:
        """See `ItemStage.change`."""
        if self.is_hit():
            self._held.append((self._passed + self._overtaken_by, item))
            self.over = False
            return []
        self._passed += 1
        going = [item]
        while self._held and self._held[0][0] <= self._passed:
            going.append(self._held.popleft()[1])
        self.over = self._where.over and not self._held
        return going

    def finish(self) -> list[T]:
        """See `ItemStage.finish`."""
        held, self._held = [item for _, item in self._held], deque()
        return held


def _no_fate(stage: object, item: object, passed: object) -> None:
    return


def pass_through(
    faults: Faults[ItemStage[T]],
    item: T,
    place: int,
    fate: Callable[[ItemStage[T], T, list[T]], None] = _no_fate,
) -> list[T]:
    """Return the items that leave in place of `item`, the one with number `place`.

    `fate` is called for each item at each stage, with the items that are passed on, after the hit has been recorded.
    """
    items = [item]
    for stage in faults.stages:
        before = stage.hits
        steps = [(each, stage.change(each)) for each in items]
        if stage.hits != before:
            faults.applied(stage, [place])
        for each, passed in steps:
            fate(stage, each, passed)
        items = [one for _, passed in steps for one in passed]
    return items
