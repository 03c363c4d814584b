"""Schedule, record and log of the faults of one link.

    rig's [[faults]] --at_s--> +
    by hand ---------inject--> + --> active stages --> over: by for_s, by count, or with the run
                                     |
                                     +--> FaultRecord for each, and a line of JSON for each begin, hit and end

The random generator is seeded by the run's seed, the link's name and the number of the fault on its link, so that a run
can be repeated.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar, cast

import numpy as np

from transports.faults.kinds import Fault, ItemStage, Stage
from transports.output_file import OutputFile

_FOREVER_US = 1 << 62
_MOST_PLACES = 16  # listed in one log line


S = TypeVar("S", bound=Stage)


@dataclass(frozen=True)
class FaultPlan:
    """Faults of one link from the rig, with the seed; `log`: file to which the lines of all are appended, or None."""

    link: str = ""
    scripted: tuple[Fault, ...] = ()
    seed: int = 0
    log: Path | None = None


@dataclass(frozen=True)
class FaultRecord:
    """Effects of one fault; `hits` and `touched` are those of its `Stage`.

    Attributes
    ----------
    number : number of the fault on its link, from 1.
    began_us, ended_us : stream time; None while it has not ended.
    log_trouble : reason for an incomplete fault log; empty if it is complete, or if there is no log.
    events_lost, edges_lost : Numbers that an intact receiver does not get because of it. If faults overlap, losses are
        attributed to the last one that was applied.
    """

    number: int
    kind: str
    began_us: int
    ended_us: int | None = None
    hits: int = 0
    touched: int = 0
    events_lost: int = 0
    edges_lost: int = 0
    log_trouble: str = ""


@dataclass
class _Injected(Generic[S]):
    stage: S
    record: FaultRecord
    until_us: int | None


class Faults(Generic[S]):
    """Faults of one link, in stream time.

    Parameters
    ----------
    build : function that makes a fault's stage; raises ValueError for a fault that this link cannot have.

    Attributes
    ----------
    stages : stages of the active faults, the oldest first.
    """

    def __init__(self, plan: FaultPlan, build: Callable[[Fault, np.random.Generator], S]) -> None:
        self._plan = plan
        self._build = build
        self._waiting = sorted(plan.scripted, key=lambda fault: fault.at_s)
        self._active: list[_Injected[S]] = []
        self.stages: list[S] = []
        self._all: list[_Injected[S]] = []
        self._cause: _Injected[S] | None = None
        self._now_us = 0
        self._log = None if plan.log is None else OutputFile(plan.log, "fault log", append=True)

    @property
    def records(self) -> tuple[FaultRecord, ...]:
        """Record of each fault."""
        trouble = "" if self._log is None else self._log.trouble
        return tuple(
            replace(effect.record, hits=effect.stage.hits, touched=effect.stage.touched, log_trouble=trouble)
            for effect in self._all
        )

    @property
    def next_us(self) -> int:
        """Stream time of the next begin of a fault; 0 while one is active, because it may end by count or by time."""
        if self._active:
            return 0
        return round(self._waiting[0].at_s * 1e6) if self._waiting else _FOREVER_US

    def advance(self, now_us: int) -> list[S]:
        """Advance stream time: begin the faults that are due; return the stages of those that have ended."""
        self._now_us = max(self._now_us, now_us)
        if not self._active and not self._waiting:
            return []
        while self._waiting and self._waiting[0].at_s * 1e6 <= self._now_us:
            fault = self._waiting.pop(0)
            self._begin(fault, round(fault.at_s * 1e6))
        over = [t for t in self._active if t.stage.over or (t.until_us is not None and t.until_us <= self._now_us)]
        for injected in over:
            self._end(injected)
        return [injected.stage for injected in over]

    def inject(self, fault: Fault) -> None:
        """Begin a fault now; raises ValueError when this link cannot have it."""
        self._begin(fault, self._now_us)

    def end(self, number: int) -> bool:
        """Let the active fault with this number end at the next `advance`; return False where there is none."""
        for injected in self._active:
            if injected.record.number == number:
                injected.until_us = self._now_us
                return True
        return False

    def applied(self, stage: S, places: list[int]) -> None:
        """Record that a stage was applied at `places`; losses from now on are attributed to it."""
        injected = next(t for t in self._active if t.stage is stage)
        self._cause = injected
        if places:
            self._write(injected, "struck", places=places[:_MOST_PLACES], hits=len(places))

    def lose(self, events: int, edges: int) -> None:
        """Count events and edges that an intact receiver does not get."""
        if self._cause is None or not (events or edges):
            return
        record = self._cause.record
        self._cause.record = replace(
            record, events_lost=record.events_lost + events, edges_lost=record.edges_lost + edges
        )
        self._write(self._cause, "lost", events=events, edges=edges)

    def close(self) -> None:
        """End all faults, and close the log."""
        for injected in list(self._active):
            self._end(injected)
        if self._log is not None:
            self._log.close()

    def _begin(self, fault: Fault, at_us: int) -> None:
        number = len(self._all) + 1
        key = (self._plan.seed, zlib.crc32(self._plan.link.encode()), number)
        stage = self._build(fault, np.random.default_rng(key))
        until_us = at_us + round(fault.for_s * 1e6) if fault.for_s else None
        injected = _Injected(stage, FaultRecord(number, fault.kind, self._now_us), until_us)
        self._active.append(injected)
        self.stages.append(stage)
        self._all.append(injected)
        self._write(injected, "began", for_s=fault.for_s)

    def _end(self, injected: _Injected[S]) -> None:
        self._active.remove(injected)
        self.stages.remove(injected.stage)
        injected.record = replace(injected.record, ended_us=self._now_us)
        self._write(injected, "ended", hits=injected.stage.hits, touched=injected.stage.touched)

    def _write(self, injected: _Injected[S], effect: str, **details: object) -> None:
        if self._log is None:
            return
        record = injected.record
        head = {"t_us": self._now_us, "link": self._plan.link, "fault": record.number, "kind": record.kind}
        self._log.write(json.dumps({**head, "what": effect, **details}).encode() + b"\n", flush=True)


class Faulty(Generic[S]):
    """Base of the path of a carrier's data through the faults of one link.

    Parameters
    ----------
    of_carrier : property of the carrier for the effects, see `Stage`.

    Attributes
    ----------
    carrier : name of the carrier, see `Fault.carriers`.
    withholds : True while a fault withholds data from the host, and the camera's buffer is not emptied.
    """

    carrier: ClassVar[str] = "this kind of link"
    withholds: bool = False

    def __init__(self, plan: FaultPlan, of_carrier: Any = None) -> None:
        self._of_carrier = of_carrier
        self._faults: Faults[S] = Faults(plan, self._effect)

    def _effect(self, fault: Fault, random: np.random.Generator) -> S:
        """Return the effect of a fault; raises ValueError for a fault of another carrier."""
        if self.carrier not in fault.carriers:
            raise ValueError(f"{fault.kind!r} is no fault of {self.carrier}")
        return cast(S, fault.stage(random, self._of_carrier))

    @property
    def records(self) -> tuple[FaultRecord, ...]:
        """Record of each fault."""
        return self._faults.records

    @property
    def next_us(self) -> int:
        """Stream time of the next begin of a fault; 0 while one is active."""
        return self._faults.next_us

    def inject(self, fault: Fault) -> None:
        """Begin a fault now; raises ValueError for a fault that this carrier does not have."""
        self._faults.inject(fault)

    def end(self, number: int) -> bool:
        """Let the active fault with this number end at the next advance; return False where there is none."""
        return self._faults.end(number)

    def close(self) -> None:
        """End all faults; the data that they hold are lost with the link."""
        self._faults.close()


T = TypeVar("T")


def pass_through(
    faults: Faults[ItemStage[T]],
    item: T,
    place: int,
    fate: Callable[[ItemStage[T], T, list[T]], None] = lambda stage, item, passed: None,
) -> list[T]:
    """Return the items that leave in place of `item`, the one with number `place`.

    `fate` is called for each item at each stage, with the items that are passed on, after the hit has been recorded.
    """
    items = [item]
    for stage in faults.stages:
        before = stage.hits
        steps = [(entering, stage.change(entering)) for entering in items]
        if stage.hits != before:
            faults.applied(stage, [place])
        for entering, leaving in steps:
            fate(stage, entering, leaving)
        items = [item for _, leaving in steps for item in leaving]
    return items
