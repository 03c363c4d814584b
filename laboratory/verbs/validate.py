"""`evstim validate`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from emulator.cli.output import GOOD, LACKING, WRONG_USE, Failure, console, print_json, status
from emulator.light import MachineLacks
from emulator.report.page import ChartsLacking, check_charts
from laboratory.validation.background import background
from laboratory.validation.findings import Experiment, Findings
from laboratory.validation.latency import latency, opposite, region, spread
from laboratory.validation.page import write
from laboratory.validation.recordings import davis346, evk4
from laboratory.validation.stars import stars

EXPERIMENTS: Mapping[str, Experiment] = {
    "latency": latency,
    "region": region,
    "spread": spread,
    "opposite": opposite,
    "davis346_street": davis346,
    "evk4_quiet": evk4,
    "background": background,
    "stars": stars,
}
"""Experiments by name, in the order of the page. An experiment is one function."""


def validate(
    *names: str,
    out: Path,
    seed: int = 1,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Repeat public measurements of real cameras on the simulated sensors; write a page, pictures and tables.

    Parameters
    ----------
    names
        Only these experiments; all without a name.
    out
        Folder to write into; created if missing.
    seed
        Fixes mismatch, noise and phases.
    json
        Print one JSON object as the last line on stdout.
    """
    unknown = [name for name in names if name not in EXPERIMENTS]
    if unknown:
        raise Failure(f"{unknown[0]!r} is no experiment: choose from {', '.join(EXPERIMENTS)}", WRONG_USE)
    try:
        check_charts()
        out.mkdir(parents=True, exist_ok=True)
    except ChartsLacking as error:
        raise Failure(str(error), LACKING) from error
    except OSError as error:
        raise Failure(f"--out {out}: {error.strerror}", WRONG_USE) from error
    try:
        found = _measured(names or tuple(EXPERIMENTS), seed)
    except MachineLacks as error:
        raise Failure(str(error), LACKING) from error
    with status.status("drawing ..."):
        files = write(found, out)
    if json:
        alike = {one.name: sum(datum.alike for datum in one.judged) for one in found}
        print_json({"alike": alike, "judged": {one.name: len(one.judged) for one in found}, "files": files})
        return GOOD
    for one in found:
        console.print(f"{one.title}: {sum(datum.alike for datum in one.judged)} of {len(one.judged)} alike")
    for path in files:
        console.print(str(path))
    return GOOD


def _measured(names: tuple[str, ...], seed: int) -> list[Findings]:
    """Run the experiments under a progress bar."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=status, transient=True) as progress:
        return [EXPERIMENTS[name](seed) for name in progress.track(names, description="measuring")]
