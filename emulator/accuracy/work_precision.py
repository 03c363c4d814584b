"""Speed against accuracy: every method over every scene in every step, one point a setting."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from emulator.accuracy.cases import Swept
from emulator.accuracy.harness import Method, score, step_cost_us
from emulator.accuracy.metrics import Scores

__all__ = ["Need", "Point", "frames_needed", "settings", "sweep"]


_LEAST_ORDER = 0.5  # below it, an error is taken not to fall with the step


@dataclass(frozen=True)
class Point:
    """One setting: a method on a scene in a step.

    Attributes
    ----------
    case, method : str
        Names.
    step_ms : float
        Time between two frames.
    frames_per_s : float
        Frames rendered for a second of stream.
    us_per_frame : float
        Pixel work of a step, 346 x 260, one thread.
    us_per_stream_ms : float
        Pixel work of a millisecond of stream.
    scores : Scores
        Against the truth.
    """

    case: str
    method: str
    step_ms: float
    frames_per_s: float
    us_per_frame: float
    us_per_stream_ms: float
    scores: Scores

    def row(self) -> dict[str, float | str]:
        """Return it as one flat row."""
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "scores"}
        return own | dataclasses.asdict(self.scores)


def settings(cases: Sequence[Swept], methods: Sequence[Method]) -> int:
    """Return how many points a sweep has."""
    return len(methods) * sum(len(swept.steps_ms) for swept in cases)


def sweep(cases: Sequence[Swept], methods: Sequence[Method]) -> Iterator[Point]:
    """Yield the points one by one."""
    for swept in cases:
        for method in methods:
            for step_ms in swept.steps_ms:
                scores = score(method, swept.case, step_ms * 1e-3)
                cost_us = step_cost_us(method, swept.case, step_ms * 1e-3)
                yield Point(swept.case.name, method.name, step_ms, 1e3 / step_ms, cost_us, cost_us / step_ms, scores)


@dataclass(frozen=True)
class Need:
    """Frames per second that a method needs for an error.

    Attributes
    ----------
    frames_per_s : float
        Infinite where no step gives the error.
    kind : str
        "between" two points of the sweep; "beyond" its shortest step, by the order of its three shortest ones; "at
        most" that of its longest step, which is short enough; "never", because the error does not fall with the step.
    """

    frames_per_s: float
    kind: Literal["between", "beyond", "at most", "never"]

    def __str__(self) -> str:
        if self.kind == "never":
            return self.kind
        mark = {"between": "", "beyond": "about ", "at most": "at most "}[self.kind]
        return f"{mark}{float(f'{self.frames_per_s:.2g}'):,.0f}".replace(",", " ")


def frames_needed(points: Sequence[Point], case: str, method: str, t95_us: float, right: float = 0.9) -> Need:
    """Return the frames per second from which on a method keeps a 95 % error and `right` of the sequences."""
    row = sorted((p for p in points if (p.case, p.method) == (case, method)), key=lambda p: p.frames_per_s)
    first = len(row)
    while first and row[first - 1].scores.right >= right and row[first - 1].scores.t95_us <= t95_us:
        first -= 1
    if first == 0:
        return Need(row[0].frames_per_s, "at most")
    if first == len(row):
        return _beyond(row, t95_us)
    worse, better = row[first - 1], row[first]
    if not worse.scores.right >= right or math.isnan(worse.scores.t95_us) or better.scores.t95_us == 0:
        return Need(better.frames_per_s, "between")
    order = _order(worse, better)
    return Need(better.frames_per_s * (better.scores.t95_us / t95_us) ** (1 / order), "between")


def _order(coarse: Point, fine: Point) -> float:
    """Return the power of the step by which the error falls."""
    fall = coarse.scores.t95_us / fine.scores.t95_us
    return math.log(fall) / math.log(fine.frames_per_s / coarse.frames_per_s) if fall > 0 else math.nan


def _beyond(row: Sequence[Point], t95_us: float) -> Need:
    """Extrapolate from the three shortest steps, if the error falls with the step."""
    if len(row) < 2:
        return Need(math.inf, "never")
    order = _order(row[-3:][0], row[-1])
    if not order >= _LEAST_ORDER:
        return Need(math.inf, "never")
    needed = row[-1].frames_per_s * (row[-1].scores.t95_us / t95_us) ** (1 / order)
    return Need(max(needed, row[-1].frames_per_s), "beyond")
