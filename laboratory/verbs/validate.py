"""`evstim validate`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from emulator.cli.output import GOOD, LACKING, WRONG_USE, Failure, Json, console, print_json, status
from emulator.light import MachineLacks
from laboratory.validation.background import background
from laboratory.validation.findings import Experiment
from laboratory.validation.latency import latency, opposite, region, spread
from laboratory.validation.page import write
from laboratory.validation.recordings import davis346, evk4
from laboratory.validation.stars import stars
from laboratory.verbs import check_drawing, collected, make_folder

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
    json: Json = False,
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
    """
    unknown = [name for name in names if name not in EXPERIMENTS]
    if unknown:
        raise Failure(f"{unknown[0]!r} is no experiment: choose from {', '.join(EXPERIMENTS)}", WRONG_USE)
    check_drawing()
    make_folder(out)
    chosen = names or tuple(EXPERIMENTS)
    try:
        findings = collected((EXPERIMENTS[name](seed) for name in chosen), len(chosen), "measuring")
    except MachineLacks as error:
        raise Failure(str(error), LACKING) from error
    with status.status("drawing ..."):
        files = write(findings, out)
    judged = {experiment.name: len(experiment.judged) for experiment in findings}
    alike = {experiment.name: sum(datum.alike for datum in experiment.judged) for experiment in findings}
    if json:
        print_json({"alike": alike, "judged": judged, "files": files})
        return GOOD
    for experiment in findings:
        console.print(f"{experiment.title}: {alike[experiment.name]} of {judged[experiment.name]} alike")
    for path in files:
        console.print(str(path))
    return GOOD
