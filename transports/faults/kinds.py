"""Base classes of faults, which a rig writes as tables with a `kind`.

A fault is one frozen dataclass: its attributes are the keys of the table. Its class statement has the `carriers` that
can have it and `effect`, the class of its effect on one, a `Stage`; a fault whose effect needs other parameters
overrides `stage`. Its kind is the class's name in small letters: BitFlips is "bit_flips". `FAULTS` contains all of them
by kind.

A fault begins at `at_s` of stream time and lasts `for_s`. Faults of single bits, bytes or frames hit each one with
probability `rate` and end after `count` hits.

`Places` draws the places of the hits in a stream of bits, bytes or frames; they do not depend on how it is divided.
`Loss`, `Repetition` and `Delay` act on single items, which are frames of a bus, datagrams or packets.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass
from operator import attrgetter
from typing import Annotated, Any, ClassVar, Generic, TypeVar

import numpy as np
from msgspec import Meta

from firmware_protocol.bounds import Bounded
from transports.registry import Registry

SERIAL_LINE = "a serial line"
CAN_BUS = "a CAN bus"
DATAGRAMS = "packets in datagrams"
GIGE_STREAM = "a GigE Vision stream"
USB_LINK = "a USB link"

_LONGEST_S = 3.2e7  # a year, the longest run

StreamSeconds = Annotated[float, Meta(ge=0, le=_LONGEST_S)]
Length = Annotated[float, Meta(gt=0, le=_LONGEST_S)]
"""Length of a fault that lasts for a while, seconds of stream time."""

Count = Annotated[int, Meta(ge=1)]
"""Number of effects after which a fault ends."""


class Stage:
    """Effect of one active fault; each carrier has its kinds of stages.

    Parameters
    ----------
    fault : the fault, whose attributes are the parameters of the effect.
    random : generator that draws the hits.
    carrier : property of the carrier on which the effect depends, if there is one.

    Attributes
    ----------
    hits : number of times that it was applied.
    touched : number of bytes, words, frames or datagrams that it changed, removed, inserted or held.
    over : True when it has no further effect.
    """

    _where: Places

    def __init__(self, fault: Any, random: np.random.Generator, carrier: Any = None) -> None:
        self._fault, self._random = fault, random
        if isinstance(fault, HitFault):
            self._where = Places(fault, random)
        self.hits = self.touched = 0
        self.over = False

    def count(self, hits: int, touched: int) -> None:
        """Count hits, and what they touched."""
        self.hits += hits
        self.touched += touched

    def hit_places(self, n: int) -> list[int]:
        """Return the indices of the next `n` units that are hit, and count them."""
        places = self._where.within(n)
        self.count(len(places), len(places))
        self.over = self._where.over
        return places


def _kind_of(name: str) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()


@dataclass(frozen=True)
class Fault(Bounded):
    """Common attributes of all faults.

    Attributes
    ----------
    kind : its name in rigs.
    carriers : carriers that can have it, such as SERIAL_LINE; a link has one, `LinkKind.carrier`.
    effect : class of its effect.
    disconnects : True: the host loses the camera, and must open it again.
    link : name of the link; "" if only one link can have this fault.
    at_s : stream time at which it begins.
    for_s : its duration, in stream time; 0: until it has hit `count` times.
    """

    kind: ClassVar[str] = ""
    carriers: ClassVar[tuple[str, ...]] = ()
    effect: ClassVar[type[Stage]] = Stage
    disconnects: ClassVar[bool] = False
    link: str = ""
    at_s: StreamSeconds = 0.0
    for_s: StreamSeconds = 0.0

    def __init_subclass__(cls, *, carriers: tuple[str, ...] = (), effect: type[Stage] | None = None) -> None:
        if "kind" not in vars(cls):
            cls.kind = _kind_of(cls.__name__)
        cls.carriers = carriers or cls.carriers
        cls.effect = effect or cls.effect

    def stage(self, random: np.random.Generator, carrier: Any) -> Stage:
        """Return the effect of this fault on a carrier; `random` draws the hits."""
        return self.effect(self, random, carrier)


@dataclass(frozen=True)
class HitFault(Fault):
    """Fault of single bits, bytes or frames.

    Attributes
    ----------
    rate : probability for each, above 0 to 1; by default the next one is hit, once.
    count : number of hits after which it ends; 0: no limit, then `for_s` sets its end.
    """

    rate: Annotated[float, Meta(gt=0, le=1)] = 1.0
    count: Annotated[int, Meta(ge=0)] = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.count and not self.for_s:
            raise ValueError("for_s is 0 and so is count: set one of them")


@dataclass(frozen=True)
class LastingFault(Fault):
    """Fault with a duration."""

    for_s: Length = 0.1


_GAPS_AT_ONCE = 256


class Places:
    """Generator of the places at which a fault hits, in order, from the gaps between them."""

    def __init__(self, fault: HitFault, random: np.random.Generator) -> None:
        self._rate = fault.rate
        self._left = fault.count or None
        self._random = random
        self._gaps: list[int] = []
        self._next = self._gap() - 1

    @property
    def over(self) -> bool:
        """True when all hits have been made."""
        return self._left == 0

    def within(self, n: int) -> list[int]:
        """Return the indices of the next `n` units that are hit, and advance behind these units."""
        places = []
        while self._next < n and self._left != 0:
            places.append(self._next)
            self._next += self._gap()
            if self._left is not None:
                self._left -= 1
        self._next -= n
        return places

    def first(self, n: int) -> int | None:
        """Return the first hit of the next `n` units, and advance behind it; None, and behind all, if there is none."""
        if self._next >= n or self._left == 0:
            self._next -= n
            return None
        place, self._next = self._next, self._gap() - 1
        if self._left is not None:
            self._left -= 1
        return place

    def _gap(self) -> int:
        if not self._gaps:
            self._gaps = self._random.geometric(self._rate, _GAPS_AT_ONCE).tolist()
        return self._gaps.pop()


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

    def is_hit(self) -> bool:
        """Return whether the next item is hit, and count it."""
        return bool(self.hit_places(1))


class Loss(HitStage[T]):
    """Loss of single items."""

    def change(self, item: T) -> list[T]:
        """Drop an item that is hit."""
        return [] if self.is_hit() else [item]


class Repetition(HitStage[T]):
    """Repetition of single items."""

    def change(self, item: T) -> list[T]:
        """Return an item that is hit twice."""
        return [item, item] if self.is_hit() else [item]


class Delay(HitStage[T]):
    """Delay of single items, each until `overtaken_by` others have passed."""

    def __init__(self, fault: HitFault, random: np.random.Generator, overtaken_by: int) -> None:
        super().__init__(fault, random)
        self._overtaken_by = overtaken_by
        self._held: deque[tuple[int, T]] = deque()  # each with the count of passed items at which it follows
        self._passed = 0

    def change(self, item: T) -> list[T]:
        """Hold an item that is hit; return any other, followed by those that it has overtaken often enough."""
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
        """Return the items that are held."""
        held, self._held = [item for _, item in self._held], deque()
        return held


_BUILT_IN = {
    "transports.faults.usb": (
        "UsbSilence", "UsbStall", "ShortTransfers", "EmptyTransfers", "FifoOverflow", "ControlStall", "SlowControl",
        "UsbUnplugged", "WrongVersion", "RegisterFlip",
    ),
    "transports.faults.words": (
        "OddBytes", "StaleData", "TimeBack", "TimeAhead", "TimeFrozen", "MissedWraps", "RepeatedEvents",
    ),
    "transports.faults.line": (
        "BitFlips", "InsertedBytes", "LostBytes", "Burst", "Overrun", "StuckLine", "WrongBaud", "Stall", "Unplugged",
    ),
    "transports.faults.datagrams": ("LostDatagrams", "RepeatedDatagrams", "LateDatagrams"),
    "transports.gige.packet_faults": ("RefusedResends", "LostHeartbeat", "LinkDown", "IpChange"),
    "transports.faults.bus": (
        "LostFrames", "RepeatedFrames", "ReorderedFrames", "ChangedFrames", "ErrorFrames", "BusOff", "DeadBus",
        "BabblingIdiot",
    ),
}  # fmt: skip

FAULTS: Registry[type[Fault]] = Registry(
    "evstim.faults",
    type[Fault],
    {_kind_of(name): f"{module}:{name}" for module, names in _BUILT_IN.items() for name in names},
    name_of=attrgetter("kind"),
)
"""Types of faults by the kind that rigs write."""
