"""`evstim bench`."""

from __future__ import annotations

import fnmatch
from typing import Annotated

from cyclopts import App, Parameter

from emulator.cli.checks import failures
from emulator.cli.output import BAD_VERDICT, GOOD, WRONG_USE, Failure, Json, console, print_json, status
from laboratory.bench.measures import MEASURES, Measure
from laboratory.bench.streams import BenchFailed
from transports.registry import unknown


def bench(
    *,
    only: Annotated[list[str] | None, Parameter(negative="")] = None,
    json: Json = False,
) -> int:
    """Measure on this machine the speeds that the documentation quotes, each as the median of several runs.

    Parameters
    ----------
    only
        Measure only this one, or those that match a pattern such as 'gpu_*'; may be given several times.
    """
    results = []
    with failures():
        for measure in _chosen(only):
            status.print(f"measuring {measure.name} ...")
            value = _value(measure)
            results.append({"name": measure.name, "value": value, "unit": measure.unit, "better": measure.better})
            if not json:
                console.print(f"{measure.name:28} {value:10.1f} {measure.unit:9} {_target(measure)}".rstrip())
    if json:
        print_json({"results": results})
    return GOOD


def _target(measure: Measure) -> str:
    mark = {"higher": ">=", "lower": "<="}[measure.better]
    return "" if measure.target is None else f"(target {mark} {measure.target:g})"


def _value(measure: Measure) -> float:
    try:
        return measure.run()
    except BenchFailed as error:
        raise Failure(f"{measure.name} cannot be measured: {error}", BAD_VERDICT) from error


def _chosen(only: list[str] | None) -> list[Measure]:
    by_name = {measure.name: measure for measure in MEASURES}
    chosen = []
    for pattern in only or ["*"]:
        names = fnmatch.filter(by_name, pattern)
        if not names:
            raise Failure(f"--only: {unknown(pattern, list(by_name))}", WRONG_USE)
        chosen += names
    return [by_name[name] for name in chosen]


verbs = App(name="bench")
verbs.default(bench)
verbs.command(
    "laboratory.verbs.realtime:realtime",
    name="realtime",
    help="Measure the speed of whole runs, link and receiver included, beside their wrong events.",
)
