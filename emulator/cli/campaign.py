"""`evstim campaign FILE`: many runs of a rig over sampled parameters; table and report in files, a summary on stdout.

`evstim campaign again FILE INDEX`: one run of a campaign once more, recorded.
`evstim campaign report FILE`: table and report of the runs that are done, without doing any.
`evstim dataset RIG --out DIR`: sequences of events with truth, each a run of a campaign that the command makes.
"""

from __future__ import annotations

import gc
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from cyclopts import App, Parameter
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from emulator.campaign import table
from emulator.campaign.campaign import Campaign, Row
from emulator.campaign.dataset import Sequences, dataset_source, write_manifest
from emulator.campaign.loading import CampaignError, SequenceTruth, load_source, proportion
from emulator.campaign.one_run import CampaignStopped, Place, run_row
from emulator.campaign.report import write_report
from emulator.campaign.workers import LocalWorkers, WarmWorker, Workers, cores, part_of, remaining, run_campaign
from emulator.cli.checks import failures, prepared
from emulator.cli.output import (
    BAD_VERDICT,
    GOOD,
    LACKING,
    WRONG_USE,
    Failure,
    Json,
    RigName,
    console,
    counted,
    failing,
    print_json,
    print_result,
    status,
)
from emulator.cli.recordings import check_record
from emulator.cli.signals import interrupt_on_stop_signals, stop_on_signals
from emulator.run.kernels import parts_of
from emulator.run.truth.source import TruthSelection
from transports.output_file import TemporaryFolder

_LINE_PERIOD_S = 10.0


class Progress:
    """Count of the rows that have been written, and display of the progress.

    Attributes
    ----------
    interrupted : whether a signal ended the campaign.
    trouble : why it could not go on, or "".
    rows : the rows that came since this command began, by the index of their run.
    """

    def __init__(self, campaign: Campaign, runs: int, done_before: int) -> None:
        self.interrupted = False
        self.trouble = ""
        self.rows: dict[int, Row] = {}
        self.run_s = 0.0
        self._wanted = runs
        self._before = done_before
        self._name = campaign.name
        self._successes = 0
        self._begun_s = self._printed_s = time.monotonic()
        columns = TextColumn(self._name), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        hidden = not status.is_terminal or status.quiet
        successes = TextColumn("{task.fields[successes]}")
        self._bar = Bar(*columns, successes, console=status, transient=True, disable=hidden)
        self._task = self._bar.add_task(self._name, total=runs, completed=done_before, successes="")

    @property
    def remaining(self) -> int:
        """Runs without a row."""
        return self._wanted - self._before - len(self.rows)

    @property
    def wall_s(self) -> float:
        """Time since the command began."""
        return time.monotonic() - self._begun_s

    def add(self, row: Row) -> None:
        """Count a row that was written."""
        self.rows[row["index"]] = row
        self._successes += bool(row["success"])
        self.run_s += float(row.get("machine.wall_s") or 0.0)
        successes = f"{self._successes} of {len(self.rows)} successful"
        self._bar.update(self._task, advance=1, successes=successes)
        if self._bar.disable and time.monotonic() - self._printed_s > _LINE_PERIOD_S:
            self._printed_s = time.monotonic()
            runs = f"{self._before + len(self.rows)} of {counted(self._wanted, 'run')}"
            status.print(f"{self._name}: {runs}, {successes}", markup=False)

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show a bar while the block lasts, where there is a terminal."""
        if self._before:
            status.print(f"{self._name}: {self._before} of {counted(self._wanted, 'run', 'are')} done", markup=False)
        with self._bar:
            yield


def finish(
    campaign: Campaign, folder: Path, progress: Progress, report: Path | None, *, in_part: bool, as_json: bool
) -> int:
    """Write table and report where the campaign is complete, print the summary and return the exit code."""
    rows = table.read_rows(table.rows_folder(folder), progress.rows)
    successes = sum(bool(row["success"]) for row in rows)
    success = proportion(successes, len(rows))
    outcomes = Counter(str(row["outcome"]) for row in rows)
    summary: dict[str, object] = {
        "campaign": campaign.name,
        "id": campaign.id,
        "runs": campaign.runs,
        "done": len(rows),
        "came": len(progress.rows),
        "outcomes": outcomes,
        "success": asdict(success),
        "wall_s": progress.wall_s,
        "run_s": progress.run_s,
        "folder": str(folder),
    }
    complete = len(rows) == campaign.runs
    if rows and (complete or report is not None) and not in_part and not progress.trouble:
        summary["report"] = _write(campaign, rows, folder, report)
    lines = [f"{campaign.name}: {len(rows)} of {counted(campaign.runs, 'run', 'are')} done"]
    lines += [f"success: {success}"] if rows else []
    lines += [f"{outcome}: {count}" for outcome, count in outcomes.items() if outcome != "ok"]
    lines += ["interrupted: the same command goes on"] if progress.interrupted else []
    lines += [f"report: {summary['report']}"] if "report" in summary else []
    console.print("\n".join(lines), markup=False)
    if progress.trouble:
        resume = f"{len(rows)} of {counted(campaign.runs, 'run', 'are')} done; the same command goes on with the others"
        raise Failure(f"{progress.trouble}. {resume}", LACKING)
    if as_json:
        print_json(summary)
    if progress.interrupted or progress.remaining:
        return BAD_VERDICT
    return GOOD if not complete or success.share >= campaign.settings.min_success else BAD_VERDICT


def _write(campaign: Campaign, rows: list[Row], folder: Path, report: Path | None) -> str:
    with failing(LACKING, OSError, at=f"table or report in {report or folder} is missing"):
        if len(rows) == campaign.runs:
            table.write_table(folder / "rows.parquet", rows)
        return str(write_report(campaign, rows, report or folder))


@contextmanager
def campaign_failures() -> Iterator[None]:
    """Turn the errors of a campaign into Failure with its exit code."""
    with (
        failing(WRONG_USE, CampaignError, table.FolderError, table.RowUnreadable),
        failing(LACKING, table.TablesLacking, CampaignStopped),
    ):
        yield


def again(
    file: Path, index: int, /, *, record: Path | None = None, folder: Path | None = None, json: Json = False
) -> int:
    """Do one run of a campaign once more, and compare it with its row.

    Exit code 1: events differ from those of the row.

    Parameters
    ----------
    file
        The campaign.
    index
        The run, from 0.
    record
        Write the delivered events to this file; its suffix determines the format.
    folder
        Of the campaign; default: beside FILE, its name without .toml.
    """
    with failures(), campaign_failures():
        campaign = Campaign(load_source(file))
        table.check_tables()
        rig = campaign.rig(index)
        if record is not None:
            check_record(rig, record)
        before = _row_before(campaign, folder or file.with_suffix(""), index)
        if before is None:
            prepared(parts_of(rig))
        interrupt_on_stop_signals()
        with TemporaryFolder("again") as place:
            row = run_row(campaign, index, Place(Path(place), record=record), lambda _: None)
    different = None
    if before is not None:
        names = [name for name in before if name.startswith("events.") or name.endswith(".digest")]
        different = [name for name in [*names, "outcome"] if before[name] != row.get(name)]
    print_result(json, {"row": row, "different": different}, _row_lines(row, different))
    return BAD_VERDICT if different else GOOD


def _row_before(campaign: Campaign, folder: Path, index: int) -> Row | None:
    rows = table.rows_folder(folder)
    if index not in table.done_rows(rows):
        return None
    row = table.read_row(rows, index)
    return row if row["campaign"] == campaign.id else None


def _row_lines(row: Row, different: list[str] | None) -> Iterator[str]:
    yield from (f"{name}: {value}" for name, value in row.items())
    if different is None:
        yield "there is no row of this run to compare with"
    elif different:
        yield f"DIFFERENT from the row of the campaign: {', '.join(different)}"
    else:
        yield "equal to the row of the campaign: all counts and digests of events"


def report(file: Path, /, *, folder: Path | None = None, to: Path | None = None, json: Json = False) -> int:
    """Write the report of the runs that are done; also while the campaign goes on.

    Parameters
    ----------
    file
        The campaign.
    folder
        Of the campaign; default: beside FILE, its name without .toml.
    to
        Folder for the report; default: the campaign's.
    """
    with failures(), campaign_failures():
        loaded = Campaign(load_source(file))
        table.check_tables()
        campaign_folder = folder or file.with_suffix("")
        table.check_folder(loaded, campaign_folder)
        done = len(table.done_rows(table.rows_folder(campaign_folder)))
        if not done:
            raise Failure(f"{campaign_folder}: no run of {loaded.name} is done", WRONG_USE)
        return finish(
            loaded, campaign_folder, Progress(loaded, done, done), to or campaign_folder, in_part=False, as_json=json
        )


@Parameter(name="*")
@dataclass(frozen=True)
class Share:
    """Selection of runs for job arrays; the folder is shared, and a last call without these options completes it.

    Attributes
    ----------
    only
        Do this run alone, from 0.
    part
        Do part I of N, such as 3/10.
    """

    only: int | None = None
    part: str | None = None


@Parameter(name="*")
@dataclass(frozen=True)
class Placement:
    """Workers or scheduler that do the runs, and folders of the results.

    Attributes
    ----------
    folder
        For rows, files of the runs and the report. Default: beside FILE, its name without .toml. A campaign that was
        interrupted goes on in it.
    workers
        Processes on this machine; default: one for each core.
    scheduler
        Address of a dask.distributed scheduler whose workers do the runs, such as tcp://10.0.0.1:8786.
    report
        Folder for the report; default: the campaign's.
    """

    folder: Path | None = None
    workers: int | None = None
    scheduler: str | None = None
    report: Path | None = None


def campaign(file: Path, /, *, share: Share = Share(), where: Placement = Placement(), json: Json = False) -> int:
    """Run a campaign, or the rest of it. Ctrl-C ends it with its summary; the same command continues it.

    Parameters
    ----------
    file
        The campaign, see docs/campaigns.md.
    """
    with failures(), campaign_failures():
        _check_workers(where)
        loaded = Campaign(load_source(file))
        table.check_tables()
        folder = where.folder or file.with_suffix("")
        indices = _wanted(loaded, share)
        in_part = share.only is not None or share.part is not None
        if in_part and where.report is not None:
            raise Failure("--report: a part of a campaign writes no report: use `evstim campaign report`", WRONG_USE)
        todo = _begun(loaded, folder, indices)
        with table.working_in(folder, alone=not in_part):
            todo = remaining(folder, todo)
            loaded.check_all(todo)
            progress = Progress(loaded, len(indices), len(indices) - len(todo))
            _run(loaded, folder, todo, where, progress)
        return finish(loaded, folder, progress, where.report, in_part=in_part, as_json=json)


def _check_workers(where: Placement) -> None:
    """Raise Failure for workers that there cannot be, before a folder is made or a kernel compiled."""
    if where.workers is not None and not 1 <= where.workers <= 1024:
        raise Failure(f"--workers must be 1 to 1024, got {where.workers}", WRONG_USE)
    if where.workers is not None and where.scheduler is not None:
        raise Failure("--workers and --scheduler: the scheduler's workers do the runs; give one of them", WRONG_USE)


def _wanted(loaded: Campaign, share: Share) -> Sequence[int]:
    if share.only is not None and share.part is not None:
        raise Failure("--only and --part: give one of them", WRONG_USE)
    if share.only is not None:
        loaded.values(share.only)  # raises CampaignError for a run that there is not
        return [share.only]
    with failing(WRONG_USE, ValueError, at="--part"):
        return range(loaded.runs) if share.part is None else part_of(share.part, loaded.runs)


def _begun(loaded: Campaign, folder: Path, indices: Sequence[int]) -> list[int]:
    """Make or check the folder, and return the runs that remain to be done."""
    option = "--out" if loaded.source.author_file else "--folder"
    with failing(WRONG_USE, OSError, at=f"{option}: {folder}"):
        remark = table.begin_folder(loaded, folder)
    if remark:
        status.print(f"note: {remark}", markup=False)
    return remaining(folder, indices)


def _run(loaded: Campaign, folder: Path, todo: list[int], where: Placement, progress: Progress) -> None:
    if not todo:
        return
    if where.scheduler is None:
        prepared(parts_of(loaded.rig(todo[0])))
    workers = _workers(loaded, folder.absolute(), len(todo), where)
    gc.freeze()  # loaded modules stay: no collection need examine them again

    def stop() -> None:
        progress.interrupted = True
        workers.stop()

    stop_on_signals(stop)
    with progress.shown():
        try:
            run_campaign(loaded, folder, todo, workers, progress.add)
        except CampaignStopped as error:
            progress.trouble = str(error)
    if not progress.interrupted:  # a report of many runs takes its time
        interrupt_on_stop_signals()


def _workers(loaded: Campaign, folder: Path, runs: int, where: Placement) -> Workers:
    if where.scheduler is not None:
        from emulator.campaign.on_dask import DaskWorkers

        return DaskWorkers(loaded, folder, where.scheduler)
    count = min(where.workers or cores(), runs)
    threads = max(1, cores() // count)
    return LocalWorkers([WarmWorker(loaded, folder, threads) for _ in range(count)])


@Parameter(name="*")
@dataclass(frozen=True)
class Content:
    """Content of the sequences.

    Attributes
    ----------
    count
        Number of points, each a sequence, or `repeats` of them; default: 100, and those of a grid.
    seconds
        Length of each, of stream time.
    seed
        Of everything random.
    vary
        TOML file with [[parameters]] and other keys of a campaign file, see docs/datasets.md. Without it sequences
        differ by their seeds.
    truth
        Of light, depth, flow, labels, poses, clean_events, with commas between; default: depth,flow,labels,poses, as
        far as the scene has them.
    rate
        Light, depth, flow and labels a second.
    format
        h5: a truth file, which readers of DSEC take for a recording; npz: the same arrays for numpy; dsec: folders of
        events and flow as the DSEC data set has them, and a truth file in each.
    """

    count: int | None = None
    seconds: float = 1.0
    seed: int = 1
    vary: Path | None = None
    truth: str = ""
    rate: float = 20.0
    format: Literal["h5", "npz", "dsec"] = "h5"


def dataset(
    rig: RigName,
    /,
    *,
    out: Path,
    content: Content = Content(),
    workers: int | None = None,
    scheduler: str | None = None,
    json: Json = False,
) -> int:
    """Make a data set, or the rest of it. Ctrl-C ends it with its summary; the same command continues it.

    Parameters
    ----------
    out
        Folder of the data set; made if missing.
    workers
        Processes on this machine; default: one for each core.
    scheduler
        Address of a dask.distributed scheduler whose workers make the sequences, such as tcp://10.0.0.1:8786.
    """
    with failures(), campaign_failures():
        where = Placement(workers=workers, scheduler=scheduler)
        _check_workers(where)
        campaign, selection = _campaign(rig, out, content)
        table.check_tables()
        if out.is_dir() and any(out.iterdir()) and not (out / "campaign.json").exists():
            raise Failure(f"--out: {out} has other files; name a new folder, or one of the same command", WRONG_USE)
        todo = _begun(campaign, out, range(campaign.runs))
        with failing(LACKING, OSError, at="--out"):
            Path(campaign.source.file).write_text(campaign.source.text)
        with table.working_in(out, alone=True):
            todo = remaining(out, todo)
            campaign.check_all(todo)
            megabytes = content.seconds * selection.pictures(campaign.rig(0))[1] / 1e6
            left = counted(len(todo), "sequence", "remain")
            status.print(f"{left}, of at most {megabytes:.3g} MB each before compression")
            progress = Progress(campaign, campaign.runs, campaign.runs - len(todo))
            _run(campaign, out, todo, where, progress)
        rows = table.read_rows(table.rows_folder(out), progress.rows)
        with failing(LACKING, OSError, at="--out"):
            manifest = write_manifest(campaign, out, rows)
        failed = [row for row in rows if row["outcome"] != "ok"]
        for row in failed[:3]:
            console.print(f"sequence {row['index']}: {row['error']}", markup=False)
        if progress.trouble:
            raise Failure(f"{progress.trouble}. The same command goes on with the others", LACKING)
        if progress.interrupted:
            console.print("interrupted: the same command goes on", markup=False)
        total = counted(campaign.runs, "sequence", "are")
        console.print(f"{len(manifest['sequences'])} of {total} in {out}", markup=False)
        if json:
            print_json({"folder": str(out), "wall_s": progress.wall_s, "run_s": progress.run_s, **manifest})
        return BAD_VERDICT if failed or progress.remaining else GOOD


def _campaign(rig: str, out: Path, content: Content) -> tuple[Campaign, TruthSelection]:
    layers = tuple(layer.strip() for layer in content.truth.split(",")) if content.truth else ()
    with failing(WRONG_USE, ValueError, at="--truth, --rate"):
        truth = SequenceTruth(content.rate, layers, content.format)
    if (content.count is not None and content.count < 1) or not 1e-6 <= content.seconds <= 86_400:
        raise Failure("--count must be 1 or more, and --seconds a microsecond to a day", WRONG_USE)
    sequences = Sequences(content.count, content.seconds, truth, content.seed, content.vary)
    return Campaign(dataset_source(rig, out.absolute() / "dataset.toml", sequences)), truth.selection


verbs = App(name="campaign")
verbs.default(campaign)
verbs.command(again, name="again")
verbs.command(report, name="report")
