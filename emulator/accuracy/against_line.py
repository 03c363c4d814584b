"""The map "hermite against line": right sequences and wrong events over blur and speed, where edges are sharp.

Steps of 5 ms, 60 pixels, the sensor of the chart. A cell is better, equal or worse by the difference of the two.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from emulator.accuracy.cases import PLAIN
from emulator.accuracy.harness import Case, Method, score
from emulator.accuracy.profiles import ShadedEdge, ThinLine, TurningBody

__all__ = [
    "BLURS_PX",
    "QUICK_SCENES",
    "SCENES",
    "SPEEDS_PX",
    "Difference",
    "cells_against_line",
    "reading_against_line",
]

STEP_S = 5e-3
BLURS_PX = 0.3, 0.6, 1.0, 3.0
SPEEDS_PX = 0.25, 0.5, 1.0, 2.0, 4.0
"""A step."""

SCENES = {
    "edge, blurred": (ShadedEdge, "blurred"),
    "edge, kinked": (ShadedEdge, "kinked"),
    "thin line, blurred": (ThinLine, "blurred"),
    "thin line, kinked": (ThinLine, "kinked"),
    "body, blurred": (TurningBody, "blurred"),
    "body, kinked": (TurningBody, "kinked"),
}
QUICK_SCENES = ("edge, kinked",)


@dataclass(frozen=True)
class Difference:
    """A scene at one blur, px, and speed, px a step: shares of right sequences and of wrong events of both."""

    scene: str
    blur_px: float
    speed_px: float
    right_line: float
    right_hermite: float
    wrong_line: float
    wrong_hermite: float

    def row(self) -> dict[str, Any]:
        """Return it as a row of a table."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


def cells_against_line(scenes: Sequence[str], ways: Sequence[Method]) -> Iterator[Difference]:
    """Yield every scene at every blur and speed."""
    line, hermite = (next(way for way in ways if way.name == name) for name in ("line", "hermite"))
    for name in scenes:
        make, profile = SCENES[name]
        for blur in BLURS_PX:
            for speed in SPEEDS_PX:
                scene = make(profile=profile, blur_px=blur, speed_px_s=speed / STEP_S)
                steps = -(-scene.duration_s // STEP_S)
                case = Case(name, scene, PLAIN, steps * STEP_S, fine_s=5e-5)
                a, b = score(line, case, STEP_S), score(hermite, case, STEP_S)
                yield Difference(name, blur, speed, a.right, b.right, a.wrong_events, b.wrong_events)


def reading_against_line(cells: Sequence[Difference]) -> list[str]:
    """Return the findings of the map, in sentences."""
    worse = [c for c in cells if c.right_hermite < c.right_line - 0.02 or c.wrong_hermite > c.wrong_line + 0.002]
    better = sum(c.right_hermite > c.right_line + 0.02 for c in cells)
    lines = [
        f"hermite against line, {len(cells)} cells: better by more than 2 points in {better}; fewer right sequences by "
        f"more than 2 points, or more wrong events by more than 0.2 %, in {len(worse)}."
    ]
    lines += [
        f"Worse: {c.scene}, {c.blur_px:g} px, {c.speed_px:g} px a step: {c.right_hermite:.1%} right and "
        f"{c.wrong_hermite:.1%} wrong, line {c.right_line:.1%} and {c.wrong_line:.1%}."
        for c in worse
    ]
    return lines
