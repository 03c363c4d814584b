"""Commands of `evstim` that judge the emulator; here what they share: the folder of results, and a bar of progress."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from emulator.cli.output import LACKING, WRONG_USE, Failure, status
from emulator.report.page import ChartsLacking, pyplot

_T = TypeVar("_T")


def check_drawing() -> None:
    """Raise Failure where charts cannot be drawn."""
    try:
        pyplot()
    except ChartsLacking as error:
        raise Failure(str(error), LACKING) from error


def make_folder(out: Path) -> None:
    """Make the folder of the results; raise Failure where that is not possible."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Failure(f"--out {out}: {error.strerror}", WRONG_USE) from error


def collected(measurements: Iterable[_T], count: int, description: str) -> list[_T]:
    """Return the results of all measurements, with a bar of progress meanwhile."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=status, transient=True) as progress:
        return list(progress.track(measurements, total=count, description=description))
