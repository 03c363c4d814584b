"""`evstim bench realtime`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from emulator.cli.checks import failures, prepared
from emulator.cli.output import BAD_VERDICT, GOOD, WRONG_USE, Failure, Json, print_result, status
from emulator.cli.signals import ignore_stop_signals
from emulator.rig.loading import shipped_rigs
from emulator.run.kernels import parts_of
from laboratory.realtime.measurements import QUICK, WHOLE, Measurements, Store, measurements_of
from laboratory.realtime.report import BEGIN, copied_charts, line_of, machine, markdown, put_section, write_report
from laboratory.realtime.variants import SIZES, distinct
from laboratory.verbs import check_drawing, make_folder

_SizeName = Literal["346x260", "1280x720"]


@dataclass(frozen=True)
class Scope:
    """Extent of the measurement.

    Attributes
    ----------
    size
        Only this size; may be given twice. Default: both.
    sweep
        Every rig in several settings: steps, samples, threads, line or rate, adaptive or fixed steps.
    quick
        Short runs, and a coarse truth over few steps: to see that it works. Its wrong events mean nothing.
    """

    size: tuple[_SizeName, ...] = ()
    sweep: bool = False
    quick: bool = False


_ALL = Scope()


def realtime(
    *rigs: str,
    out: Path,
    scope: Annotated[Scope, Parameter(name="*", negative="")] = _ALL,
    page: Path | None = None,
    json: Json = False,
) -> int:
    """Measure the speed of whole runs, link and receiver included, beside their wrong events; write charts and tables.

    Each measurement is stored in the folder as it ends: the same command goes on after Ctrl-C, which writes the report
    of what there is.

    Parameters
    ----------
    rigs
        Paths of rig files, or names of shipped ones. Default: all shipped ones that differ in more than their links.
    out
        Folder to write into; created if missing.
    page
        Replace the section of measured values in this Markdown page, and put the chart into `pictures` beside it.
    """
    with failures():
        measurements = _measurements(rigs, scope, out, page)
        is_whole = _measure(measurements)
    rows, about = measurements.rows(), _about(measurements, scope, is_whole)
    files = _written(rows, about, out, page)
    print_result(json, {**about, "rows": rows, "files": files}, _lines(rows, about, files))
    return GOOD if is_whole and not measurements.failures else BAD_VERDICT


def _measurements(rigs: Sequence[str], scope: Scope, out: Path, page: Path | None) -> Measurements:
    """Return what is to be measured, once the results can be written; raises Failure."""
    if scope.quick and page is not None:
        raise Failure("--page: quick values are not for the docs; leave out --quick", WRONG_USE)
    check_drawing()
    make_folder(out)
    try:
        store = Store(out / "realtime.jsonl")
        if page is not None and BEGIN not in page.read_text():
            raise Failure(f"--page: {page} has no line {BEGIN}", WRONG_USE)
    except OSError as error:
        raise Failure(f"{error.filename}: {error.strerror}", WRONG_USE) from error
    names = rigs or list(distinct(shipped_rigs()))
    sizes = [size for size in SIZES if not scope.size or size.name in scope.size]
    variants = list(measurements_of(names, sizes, sweep=scope.sweep))
    return Measurements(variants, store, QUICK if scope.quick else WHOLE)


def _measure(measurements: Measurements) -> bool:
    """Measure under a progress bar; return whether all was measured, False after Ctrl-C."""
    loaded = [one.variant.loaded() for one in measurements.wanted]
    prepared(list({part.key: part for rig in loaded for part in parts_of(rig)}.values()))
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    try:
        with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=status) as progress:
            task = progress.add_task("", total=len(measurements.wanted))
            for done, one in enumerate(measurements.run()):
                progress.update(task, completed=done, description=one.name)
            progress.update(task, completed=len(measurements.wanted), description="measured")
    except KeyboardInterrupt:
        status.print("interrupted: the same command goes on from here")
        return False
    finally:
        ignore_stop_signals()
    return True


def _about(measurements: Measurements, scope: Scope, is_whole: bool) -> dict[str, Any]:
    quick = "quick: the wrong events mean nothing" if scope.quick else ""
    partial = "" if is_whole else "interrupted: not all was measured"
    return {
        "evstim": version("evstim"),
        "machine": machine(),
        "date": date.today().isoformat(),
        "note": ", ".join(note for note in (quick, partial) if note),
        "failures": measurements.failures,
    }


def _written(rows: list[dict[str, Any]], about: dict[str, Any], out: Path, page: Path | None) -> list[Path]:
    """Write the report, and the section of the page; return the files."""
    if not rows:
        return []
    files = write_report(rows, about, out)
    if page is None:
        return files
    put_section(page, markdown(rows, about, copied_charts(files, page)))
    return [*files, page]


def _lines(rows: list[dict[str, Any]], about: dict[str, Any], files: list[Path]) -> list[str]:
    failed = [f"NOT MEASURED: {name}: {reason}" for name, reason in about["failures"].items()]
    notes = [about["note"]] if about["note"] else []
    return [*map(line_of, rows), *failed, *notes, *map(str, files)]
