"""`evstim validate`."""

from __future__ import annotations

from pathlib import Path

from emulator.cli.output import GOOD, LACKING, WRONG_USE, Failure, Json, print_result, status
from emulator.light import MachineLacks
from laboratory.validation.background import background, dnd21, noise2params
from laboratory.validation.findings import Experiment, over_seeds
from laboratory.validation.latency import gen31, latency, opposite, region, spread
from laboratory.validation.page import within, write
from laboratory.validation.recordings import davis346_street, evk4_quiet
from laboratory.validation.stars import stars
from laboratory.verbs import check_drawing, collected, make_folder

EXPERIMENTS: dict[str, Experiment] = {
    measure.__name__: measure
    for measure in (
        latency, region, spread, opposite, gen31, noise2params, davis346_street, evk4_quiet, background, dnd21, stars,
    )
}  # fmt: skip
"""In the order of the page."""


def validate(*names: str, out: Path, seeds: int = 8, json: Json = False) -> int:
    """Repeat public measurements of real cameras on the simulated sensors; write pages, pictures and tables.

    Parameters
    ----------
    names
        Only these experiments; all without a name.
    out
        Folder to write into; created if missing.
    seeds
        Number of simulated sensors, each with its own mismatch, noise and phases.
    """
    unknown = [name for name in names if name not in EXPERIMENTS]
    if unknown:
        raise Failure(f"{unknown[0]!r} is no experiment: choose from {', '.join(EXPERIMENTS)}", WRONG_USE)
    if seeds < 1:
        raise Failure(f"--seeds {seeds}: at least 1", WRONG_USE)
    check_drawing()
    make_folder(out)
    chosen = [EXPERIMENTS[name] for name in names or EXPERIMENTS]
    runs = (measure(seed) for measure in chosen for seed in range(1, seeds + 1))
    try:
        done = collected(runs, len(chosen) * seeds, "measuring")
    except MachineLacks as error:
        raise Failure(str(error), LACKING) from error
    found = [over_seeds(done[k : k + seeds]) for k in range(0, len(done), seeds)]
    with status.status("drawing ..."):
        files = write(found, out)
    alike = {
        f"{one.title}, {name}": f"{within(rows)} of {len(rows)}"
        for one in found
        for name, fitted in (("predicted", False), ("fitted", True))
        if (rows := one.rows(fitted))
    }
    lines = [f"{name}: {n} within the bound" for name, n in alike.items()]
    print_result(json, {"within": alike, "files": files}, [*lines, *map(str, files)])
    return GOOD
