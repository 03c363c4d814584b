"""`evstim accuracy`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from cyclopts import Parameter
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from emulator.accuracy.cases import CASES, QUICK
from emulator.accuracy.effects import EFFECTS, QUICK_EFFECTS, effect_rows
from emulator.accuracy.harness import methods
from emulator.accuracy.rendering import SETTINGS, fits, rendering_rows
from emulator.accuracy.report import write_rendering, write_stability, write_work_precision
from emulator.accuracy.stability import QUICK_SWEEPS, SWEEPS, cells
from emulator.accuracy.work_precision import settings, sweep
from emulator.cli.failures import failures
from emulator.cli.output import GOOD, LACKING, WRONG_USE, Failure, console, print_json, status
from emulator.report.figures import ChartsLacking, check
from emulator.rig.loading import load_rig, shipped_rigs

__all__ = ["accuracy"]

_Item = TypeVar("_Item")
_EFFECTS_STEP_S = 1e-3
_PICTURES, _QUICK_PICTURES = 24, 4


def accuracy(
    what: Literal["chart", "stability", "rendering"] = "chart",
    *,
    out: Path,
    quick: Annotated[bool, Parameter(negative="")] = False,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Compare the pixel model, and the rules of other simulators, with the truth; write charts, tables and a page.

    Parameters
    ----------
    what
        "chart": timestamp error and wrong events against work, and what each effect costs and changes.
        "stability": where each method fails.
        "rendering": false and missed events of the shipped rigs' scenes against the time that a picture takes.
    out
        Folder to write into; created if missing.
    quick
        Fewer scenes and steps; takes seconds.
    json
        Print one JSON object as the last line on stdout.
    """
    try:
        check()
        out.mkdir(parents=True, exist_ok=True)
    except ChartsLacking as error:
        raise Failure(str(error), LACKING) from error
    except OSError as error:
        raise Failure(f"--out {out}: {error.strerror}", WRONG_USE) from error
    files = {"chart": _chart, "stability": _stability, "rendering": _rendering}[what](out, quick)
    if json:
        print_json({"files": files})
    else:
        for path in files:
            console.print(str(path))
    return GOOD


def _chart(out: Path, quick: bool) -> list[Path]:
    chosen, ways = QUICK if quick else CASES, methods()
    points = _all(sweep(chosen, ways), settings(chosen, ways), "points")
    board = next(swept.case for swept in chosen if swept.case.name == "checkerboard")
    switched = QUICK_EFFECTS if quick else EFFECTS
    effects = _all(effect_rows(board, _EFFECTS_STEP_S, switched), len(switched), "effects")
    return _written(lambda: write_work_precision(points, effects, chosen, out))


def _stability(out: Path, quick: bool) -> list[Path]:
    chosen, ways = QUICK_SWEEPS if quick else SWEEPS, methods()
    found = _all(cells(chosen, ways), len(ways) * sum(len(axis.values) for axis in chosen), "cells")
    return _written(lambda: write_stability(found, chosen, out))


def _rendering(out: Path, quick: bool) -> list[Path]:
    with failures():
        rigs = [rig for rig in map(load_rig, shipped_rigs()) if fits(rig)]
        rigs = rigs[:1] if quick else rigs
        count = len(SETTINGS) * len(rigs)
        rows = _all(rendering_rows(rigs, _QUICK_PICTURES if quick else _PICTURES), count, "settings")
    return _written(lambda: write_rendering(rows, out))


def _all(items: Iterable[_Item], count: int, what: str) -> list[_Item]:
    """Collect items under a progress bar."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=status, transient=True) as progress:
        return list(progress.track(items, total=count, description=what))


def _written(write: Callable[[], list[Path]]) -> list[Path]:
    with status.status("drawing ..."):
        return write()
