"""`evstim accuracy peers`, `export` and `score`: other simulators on the closed-form scenes.

`export` writes frames and the events of ideal pixels, `score` compares events with these, and `peers` does both around
runs of simulators under adapters.
"""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from emulator.cli.output import BAD_VERDICT, GOOD, WRONG_USE, Failure, Json, print_result, status
from laboratory.accuracy.peers.page import BEGIN, END, markdown, read_results, write_page
from laboratory.accuracy.peers.running import BUNDLED, NEEDS_NO_PATH, OURS, Adapter, run_adapter
from laboratory.accuracy.peers.scoring import Report, Summary, score_events, write_report
from laboratory.accuracy.peers.sequences import (
    IMAGES_PER_S,
    SCENES,
    FolderError,
    SequenceFolder,
    open_folder,
    timing_sequences,
)
from laboratory.accuracy.peers.sequences import export as export_sequences
from laboratory.realtime.report import copied_charts, machine, put_section
from laboratory.verbs import check_drawing, collected
from transports.output_file import TemporaryFolder


@dataclass(frozen=True)
class Simulators:
    """Simulators to run.

    Attributes
    ----------
    simulator
        NAME or NAME=PATH, of v2e, esim, openeb, iebcs, dvs_voltmeter, evlib, eventcv, neurosim; PATH is its checkout.
        Give it once for each. evstim stands for ours, and is the default.
    adapter
        FILE.py:MAKE or FILE.py:MAKE=PATH, an adapter of your own.
    python
        Interpreter that has the simulators; that of evstim otherwise.
    limit_s
        Longest time for a sequence.
    threads
        Threads for each simulator; 0: as many as it takes.
    """

    simulator: Annotated[tuple[str, ...], Parameter(negative="")] = ()
    adapter: Annotated[tuple[str, ...], Parameter(negative="")] = ()
    python: Path | None = None
    limit_s: float = 300.0
    threads: int = 1

    def adapters(self) -> dict[str, Adapter]:
        """Return the adapters by the name of their results; raises Failure for a name that there is not."""
        python = sys.executable if self.python is None else str(self.python.absolute())
        if shutil.which(python) is None:
            raise Failure(f"--python {self.python}: there is no such program", WRONG_USE)
        chosen = self.simulator if self.simulator or self.adapter else ("evstim",)
        found: dict[str, Adapter] = {}
        for text in chosen:
            name, _, path = text.partition("=")
            if name == "evstim":
                found |= {ours: Adapter.bundled(ours, sys.executable, threads=self.threads) for ours in OURS}
            else:
                found[name] = Adapter.bundled(name, python, _simulator_path(name, path), self.threads)
        for text in self.adapter:
            place, _, path = text.partition("=")
            file, colon, make = place.rpartition(":")
            if not colon or not Path(file).is_file():
                raise Failure(f"--adapter {text}: must be FILE.py:MAKE, and the file must exist", WRONG_USE)
            place = f"{Path(file).absolute()}:{make}"
            found[f"{Path(file).stem}-{make}"] = Adapter(python, place, path, self.threads)
        return found


def _simulator_path(name: str, path: str) -> str:
    if name not in BUNDLED:
        raise Failure(f"--simulator {name}: there is evstim, {', '.join(BUNDLED)}; or take --adapter", WRONG_USE)
    if not path and name not in NEEDS_NO_PATH:
        raise Failure(f"--simulator {name}: give the path of its checkout, {name}=PATH", WRONG_USE)
    if path and not Path(path).exists():
        raise Failure(f"--simulator {name}: there is no {path}", WRONG_USE)
    return str(Path(path).absolute()) if path else ""


@dataclass(frozen=True)
class Sequences:
    """Sequences of frames.

    Attributes
    ----------
    scene
        edge, grating, ramp, line, body or checkerboard; give it once for each. All otherwise.
    images_per_s
        A frame rate; give it once for each. 100, 1000 and 10000 otherwise.
    """

    scene: Annotated[tuple[str, ...], Parameter(negative="")] = tuple(SCENES)
    images_per_s: Annotated[tuple[int, ...], Parameter(negative="")] = IMAGES_PER_S

    def check(self) -> None:
        """Raise Failure for a scene that there is not, or a rate that gives no whole number of frames."""
        for name in self.scene:
            if name not in SCENES:
                raise Failure(f"--scene {name}: there is {', '.join(SCENES)}", WRONG_USE)
        for rate in self.images_per_s:
            if rate < 1 or any(round(SCENES[name].duration_s * 1e3) * rate % 1000 for name in self.scene):
                raise Failure(f"--images-per-s {rate}: the scenes must last a whole number of frames", WRONG_USE)

    def names(self) -> set[str]:
        """Return the names of all sequences."""
        scored = {f"{scene}-{rate}" for scene in self.scene for rate in self.images_per_s}
        return scored | set(timing_sequences(self.images_per_s))


_ALL, _OURS = Sequences(), Simulators()


def export(
    folder: Path,
    /,
    *,
    which: Annotated[Sequences, Parameter(name="*")] = _ALL,
    json: Json = False,
) -> int:
    """Write the frames of closed-form scenes and the events of ideal pixels, for simulators of your own.

    Parameters
    ----------
    folder
        Folder to write into; created if missing. All sequences take 120 MB.
    """
    opened = _exported(folder, which)
    value = {"folder": folder, "sequences": list(opened.sequences)}
    print_result(json, value, [f"{len(opened.sequences)} sequences in {folder}"])
    return GOOD


def score(
    folder: Path,
    events: Path,
    /,
    *,
    name: str = "simulator",
    out: Path | None = None,
    json: Json = False,
) -> int:
    """Score events of the sequences of `evstim accuracy export`: one file for each, SEQUENCE.npz or SEQUENCE.csv.

    Parameters
    ----------
    folder
        The folder that was exported.
    events
        Folder of the events: columns t_us, x, y, on.
    name
        Name of the simulator.
    out
        Folder of results, as of `evstim accuracy peers`: put these among the others, and write its page anew.
    """
    try:
        opened = open_folder(folder)
        scores, times, remarks = score_events(opened, events, {})
    except FolderError as error:
        raise Failure(str(error), WRONG_USE) from error
    report = Report({"name": name}, date.today().isoformat(), machine(), scores, times, remarks)
    files = [] if out is None else _with_page({_key(name): report}, out, None)
    return _result([report], files, json)


def peers(
    *,
    out: Path,
    chosen: Annotated[Simulators, Parameter(name="*")] = _OURS,
    which: Annotated[Sequences, Parameter(name="*")] = _ALL,
    page: Path | None = None,
    json: Json = False,
) -> int:
    """Run simulators of event cameras over closed-form scenes, and write a table of their errors and costs.

    Each runs in a process of its own; results of earlier runs into the same folder stay in the table.

    Parameters
    ----------
    out
        Folder to write into; created if missing.
    page
        Replace the section of measured values in this Markdown page, and put the chart into `pictures` beside it.
    """
    adapters = chosen.adapters()
    check_drawing()
    if page is not None and not (page.is_file() and BEGIN in page.read_text()):
        raise Failure(f"--page: {page} has no line {BEGIN}", WRONG_USE)
    opened = _exported(out / "sequences", which)
    reports = {}
    for name, adapter in adapters.items():
        reports[name] = _measured(name, adapter, opened, chosen.limit_s)
        _save({name: reports[name]}, out)
    return _result(list(reports.values()), _with_page({}, out, page), json)


def _exported(folder: Path, which: Sequences) -> SequenceFolder:
    """Return the folder with these sequences, written if it does not have exactly them."""
    which.check()
    try:
        opened = open_folder(folder)
        if set(opened.sequences) == which.names():
            return opened
    except FolderError:
        pass
    try:
        collected(export_sequences(folder, which.images_per_s, which.scene), len(which.names()), "sequences")
    except OSError as error:
        raise Failure(f"{folder}: {error.strerror}", WRONG_USE) from error
    return open_folder(folder)


def _measured(name: str, adapter: Adapter, folder: SequenceFolder, limit_s: float) -> Report:
    """Run a simulator over all sequences; return its report."""
    with TemporaryFolder("events") as events, _bar() as progress:
        task = progress.add_task(name, total=len(folder.sequences))
        done = lambda _: progress.advance(task)  # noqa: E731
        outcome = run_adapter(adapter, folder.path, list(folder.sequences), Path(events), limit_s, done)
        scores, times, remarks = score_events(folder, Path(events), outcome.failures)
    about = {**outcome.about, "name": outcome.about.get("name") or name}
    return Report(about, date.today().isoformat(), machine(), scores, times, remarks)


def _bar() -> Progress:
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    return Progress(*columns, console=status, transient=True)


def _key(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", name)


def _save(reports: dict[str, Report], out: Path) -> None:
    (out / "results").mkdir(parents=True, exist_ok=True)
    for name, report in reports.items():
        write_report(report, out / "results" / f"{_key(name)}.json")


def _with_page(reports: dict[str, Report], out: Path, page: Path | None) -> list[Path]:
    """Save reports, and write the page of all results in a folder, and the section of a page of the docs."""
    try:
        _save(reports, out)
        every = read_results(out)
        files = write_page(every, out)
        if page is None:
            return files
        put_section(page, markdown(every, copied_charts(files, page)), (BEGIN, END))
    except (OSError, ValueError) as error:
        raise Failure(str(error), WRONG_USE) from error
    return [*files, page]


def _result(reports: Sequence[Report], files: Sequence[Path], json: bool) -> int:
    """Print summaries; return BAD_VERDICT where a simulator has no score at all."""
    summaries = [(report, one) for report in reports for one in report.summaries()]
    found: dict[str, Any] = {report.name: [asdict(one) for one in report.summaries()] for report in reports}
    failures = {report.name: report.failures() for report in reports}
    lines = [_line(report.name, one) for report, one in summaries]
    lines += [f"NOT SCORED: {k}: {', '.join(names)}: {why}" for k, of in failures.items() for why, names in of.items()]
    value = {"simulators": found, "failures": failures, "files": list(files)}
    print_result(json, value, [*lines, *map(str, files)])
    scored = {report.name for report, one in summaries if one.scenes}
    return GOOD if scored == {report.name for report in reports} else BAD_VERDICT


def _line(name: str, one: Summary) -> str:
    """Return a summary as one line for people."""
    if one.right is None or one.false is None or one.missed is None:
        return f"{name:22} {one.images_per_s:6g} images/s  no scene of {one.of} scored"
    times = "  -" if one.t50_us is None or one.t95_us is None else f"{one.t50_us:9.3g} / {one.t95_us:9.3g} us"
    wrong = f"{100 * one.false:.2g} % false, {100 * one.missed:.2g} % missed"
    return f"{name:22} {one.images_per_s:6g} images/s  {100 * one.right:5.1f} % right  t50/t95 {times}  {wrong}"
