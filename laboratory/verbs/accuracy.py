"""`evstim accuracy`: our methods and PANGU's rule against the truth.

`evstim accuracy peers`, `export` and `score`: other simulators as they are, on the same scenes (`accuracy_peers`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from emulator.cli.checks import failures
from emulator.cli.output import GOOD, WRONG_USE, Failure, Flag, Json, print_result, status
from emulator.rig.loading import Rig, load_rig, shipped_rigs
from laboratory.accuracy.harness import CASES, QUICK, methods
from laboratory.accuracy.rendering import LADDER, Stretch, fits, rendering_rows, rows_of
from laboratory.accuracy.report import (
    reading_of_rendering,
    write_against_line,
    write_rendering,
    write_stability,
    write_work_precision,
)
from laboratory.accuracy.stability import QUICK_SWEEPS, SWEEPS, cells
from laboratory.accuracy.sweeps import (
    BLURS_PX,
    EFFECTS,
    QUICK_EFFECTS,
    QUICK_SCENES,
    SCENES,
    SPEEDS_PX,
    cells_against_line,
    effect_rows,
    settings,
    sweep,
)
from laboratory.realtime.variants import SIZES, variant_of
from laboratory.verbs import check_drawing, collected, make_folder

_EFFECTS_STEP_S = 1e-3
_QUICK_STRETCH = Stretch(steps=4, samples=4, finer=4)


def accuracy(
    what: Literal["chart", "stability", "rendering", "ladder"] = "chart",
    *,
    out: Path,
    rig: Annotated[tuple[str, ...], Parameter(negative="")] = (),
    as_shipped: Flag = False,
    quick: Flag = False,
    json: Json = False,
) -> int:
    """Compare the pixel model, and PANGU's rule, with the truth; write charts, tables and a page.

    Parameters
    ----------
    what
        "chart": timestamp error and wrong events against work, and the cost and the effect on events of each effect.
        "stability": where each method fails, and the map of hermite against line over blur and speed.
        "rendering": false and missed events of the shipped rigs' scenes against the time of drawing a step.
        "ladder": the same at 346x260 and 1280x720 for settings that differ in time alone, from the cheapest on, beside
        exact drawings in steps of a quarter; also printed.
    out
        Folder to write into; created if missing.
    rig
        For these two: only these rigs, shipped or files; give it once for each. All shipped ones take an hour.
    as_shipped
        For "rendering": only the first way to draw, that of a run.
    quick
        Fewer scenes and steps; takes seconds.
    """
    check_drawing()
    make_folder(out)
    ways: dict[str, Callable[[Path, bool], list[Path]]] = {"chart": _chart, "stability": _stability}
    ways["rendering"] = partial(_rendering, rig, as_shipped=as_shipped, ladder=False)
    ways["ladder"] = partial(_rendering, rig, as_shipped=as_shipped, ladder=True)
    files = ways[what](out, quick)
    print_result(json, {"files": files}, [str(path) for path in files])
    return GOOD


def _chart(out: Path, quick: bool) -> list[Path]:
    chosen, ways = QUICK if quick else CASES, methods()
    points = collected(sweep(chosen, ways), settings(chosen, ways), "points")
    board = next(swept.case for swept in chosen if swept.case.name == "checkerboard")
    switched = QUICK_EFFECTS if quick else EFFECTS
    effects = collected(effect_rows(board, _EFFECTS_STEP_S, switched), len(switched), "effects")
    return _written(lambda: write_work_precision(points, effects, chosen, out))


def _stability(out: Path, quick: bool) -> list[Path]:
    chosen, ways = QUICK_SWEEPS if quick else SWEEPS, methods()
    found = collected(cells(chosen, ways), len(ways) * sum(len(axis.values) for axis in chosen), "cells")
    scenes = QUICK_SCENES if quick else tuple(SCENES)
    count = len(scenes) * len(BLURS_PX) * len(SPEEDS_PX)
    against = collected(cells_against_line(scenes, ways), count, "against line")
    return _written(lambda: [*write_stability(found, chosen, out), *write_against_line(against, out)])


def _rendering(names: tuple[str, ...], out: Path, quick: bool, *, as_shipped: bool, ladder: bool) -> list[Path]:
    with failures():
        rigs = _rigs(names, ladder=ladder)[: 1 if quick else None]
        stretch = LADDER if ladder else _QUICK_STRETCH if quick else None
        count = rows_of(rigs, stretch, as_shipped=as_shipped)
        rows = collected(rendering_rows(rigs, stretch, as_shipped=as_shipped), count, "settings")
    if ladder:
        status.print("\n".join(reading_of_rendering(rows)), markup=False)
    return _written(lambda: write_rendering(rows, out))


def _rigs(names: tuple[str, ...], *, ladder: bool) -> list[Rig]:
    """Return rigs with bodies or terrain; for a ladder each at both sizes."""
    fit = {name: rig for name in names or shipped_rigs() if fits(rig := load_rig(name))}
    if unfit := [name for name in names if name not in fit]:
        raise Failure(f"--rig {unfit[0]}: its scene has no bodies and no terrain", WRONG_USE)
    if not ladder:
        return [*fit.values()]
    sized = [(variant_of(name, size).loaded(), size.name) for name in fit for size in SIZES]
    return [replace(rig, name=f"{rig.name}@{size_name}") for rig, size_name in sized]


def _written(write: Callable[[], list[Path]]) -> list[Path]:
    with status.status("drawing ..."):
        return write()


verbs = App(name="accuracy")
verbs.default(accuracy)
for verb, summary in (
    ("peers", "Run other simulators over closed-form scenes: a table of their errors and costs."),
    ("export", "Write the frames of the closed-form scenes, and the events of ideal pixels."),
    ("score", "Score the events that a simulator made of exported frames."),
):
    verbs.command(f"laboratory.verbs.accuracy_peers:{verb}", name=verb, help=summary)
