"""What `evstim campaign` shows: progress on stderr, a summary on stdout, the table and the report in files."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from emulator.campaign.campaign import Campaign
from emulator.campaign.columns import Row
from emulator.campaign.folder import FolderError, rows_folder
from emulator.campaign.loading import CampaignError
from emulator.campaign.one_run import CampaignStopped
from emulator.campaign.proportion import proportion
from emulator.campaign.report.page import write_report
from emulator.campaign.table import RowUnreadable, TablesLacking, read_rows, write_table
from emulator.cli.output import BAD_VERDICT, GOOD, LACKING, WRONG_USE, Failure, console, print_json, status

__all__ = ["Progress", "campaign_failures", "finish"]

_LINE_PERIOD_S = 10.0


class Progress:
    """Counts the rows as they come, and shows how the campaign stands.

    Attributes
    ----------
    interrupted : whether a signal ended the campaign.
    trouble : why it could not go on, or "".
    rows : the rows that came since this command began, by the index of their run.
    """

    def __init__(self, campaign: Campaign, wanted: int, done_before: int) -> None:
        self.interrupted = False
        self.trouble = ""
        self.rows: dict[int, Row] = {}
        self.run_s = 0.0
        self._wanted = wanted
        self._before = done_before
        self._name = campaign.name
        self._successes = 0
        self._begun_s = self._told_s = time.monotonic()
        self._bar: Bar | None = None

    @property
    def came(self) -> int:
        """Rows that came since this command began."""
        return len(self.rows)

    @property
    def remaining(self) -> int:
        """Runs without a row."""
        return self._wanted - self._before - self.came

    @property
    def wall_s(self) -> float:
        """Time since the command began."""
        return time.monotonic() - self._begun_s

    def add(self, row: Row) -> None:
        """Take note of a row that was written."""
        self.rows[row["index"]] = row
        self._successes += bool(row["success"])
        self.run_s += float(row.get("machine.wall_s") or 0.0)
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], advance=1, told=self._told)
        elif time.monotonic() - self._told_s > _LINE_PERIOD_S:
            self._told_s = time.monotonic()
            status.print(f"{self._name}: {self._before + self.came} of {self._wanted} runs, {self._told}", markup=False)

    @property
    def _told(self) -> str:
        return f"{self._successes} of {self.came} successes"

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show a bar while the block lasts, where there is a terminal."""
        if self._before:
            status.print(f"{self._name}: {self._before} of {self._wanted} runs are done", markup=False)
        if not status.is_terminal or status.quiet:
            yield
            return
        columns = TextColumn(self._name), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        with Bar(*columns, TextColumn("{task.fields[told]}"), console=status, transient=True) as bar:
            bar.add_task(self._name, total=self._wanted, completed=self._before, told="")
            self._bar = bar
            yield
        self._bar = None


def finish(
    campaign: Campaign, folder: Path, progress: Progress, report: Path | None, *, in_part: bool, as_json: bool
) -> int:
    """Write table and report where the campaign is complete, print the summary and return the exit code."""
    rows = read_rows(rows_folder(folder), progress.rows)
    successes = sum(bool(row["success"]) for row in rows)
    known = proportion(successes, len(rows))
    outcomes = Counter(str(row["outcome"]) for row in rows)
    told: dict[str, object] = {
        "campaign": campaign.name,
        "id": campaign.id,
        "runs": campaign.runs,
        "done": len(rows),
        "came": progress.came,
        "outcomes": outcomes,
        "success": asdict(known),
        "wall_s": progress.wall_s,
        "run_s": progress.run_s,
        "folder": str(folder),
    }
    complete = len(rows) == campaign.runs
    if rows and (complete or report is not None) and not in_part and not progress.trouble:
        told["report"] = _write(campaign, rows, folder, report)
    _print(told, outcomes, str(known), progress)
    if progress.trouble:
        resume = f"{len(rows)} of {campaign.runs} runs are done; the same command goes on with the others"
        raise Failure(f"{progress.trouble}. {resume}", LACKING)
    if as_json:
        print_json(told)
    if progress.interrupted or progress.remaining:
        return BAD_VERDICT
    return GOOD if not complete or known.share >= campaign.settings.min_success else BAD_VERDICT


def _write(campaign: Campaign, rows: list[Row], folder: Path, report: Path | None) -> str:
    try:
        if len(rows) == campaign.runs:
            write_table(folder / "rows.parquet", rows)
        return str(write_report(campaign, rows, report or folder))
    except OSError as error:
        told = f"{error.filename or folder}: {error.strerror or error}: table or report is missing"
        raise Failure(told, LACKING) from error


def _print(told: dict[str, object], outcomes: Counter[str], success: str, progress: Progress) -> None:
    console.print(f"{told['campaign']}: {told['done']} of {told['runs']} runs are done", markup=False)
    if told["done"]:
        console.print(f"success: {success}", markup=False)
    for outcome, count in outcomes.items():
        if outcome != "ok":
            console.print(f"{outcome}: {count}", markup=False)
    if progress.interrupted:
        console.print("interrupted: the same command goes on", markup=False)
    if "report" in told:
        console.print(f"report: {told['report']}", markup=False)


@contextmanager
def campaign_failures() -> Iterator[None]:
    """Turn the errors of a campaign into Failure with its exit code."""
    try:
        yield
    except (TablesLacking, CampaignStopped) as error:
        raise Failure(str(error), LACKING) from error
    except (CampaignError, FolderError, RowUnreadable) as error:
        raise Failure(str(error), WRONG_USE) from error
