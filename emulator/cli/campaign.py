"""`evstim campaign FILE`: many runs of a rig over sampled parameters."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from emulator.campaign.campaign import Campaign
from emulator.campaign.folder import begin_folder, working_in
from emulator.campaign.loading import load_source
from emulator.campaign.local import LocalWorkers, cores
from emulator.campaign.one_run import CampaignStopped
from emulator.campaign.running import Workers, part_of, remaining, run_campaign
from emulator.campaign.table import check_tables
from emulator.campaign.warm_worker import WarmWorker
from emulator.cli.campaign_again import again
from emulator.cli.campaign_output import Progress, campaign_failures, finish
from emulator.cli.campaign_report import report
from emulator.cli.failures import failures
from emulator.cli.output import WRONG_USE, Failure, status
from emulator.cli.preparing import prepared
from emulator.cli.signals import interrupt_on_stop_signals, stop_on_signals
from emulator.run.kernels import parts_of

__all__ = ["campaign", "verbs"]


@dataclass(frozen=True)
class Share:
    """Which runs to do, for job arrays; the folder is shared, and a last call without these completes it.

    Attributes
    ----------
    only
        Do this run alone, from 0.
    part
        Do part I of N, such as 3/10.
    """

    only: int | None = None
    part: str | None = None


@dataclass(frozen=True)
class Where:
    """Where the runs are done and where their rows go.

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


_ALL = Share()
_HERE = Where()


def campaign(
    file: Path,
    /,
    *,
    share: Annotated[Share, Parameter(name="*")] = _ALL,
    where: Annotated[Where, Parameter(name="*")] = _HERE,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Run a campaign, or what remains of it. Ctrl-C ends it with its summary; the same command goes on with it.

    Parameters
    ----------
    file
        The campaign, see docs/campaigns.md.
    json
        Print one JSON object as the last line on stdout.
    """
    with failures(), campaign_failures():
        made = Campaign(load_source(file))
        check_tables()
        folder = where.folder or file.with_suffix("")
        wanted = _wanted(made, share)
        in_part = share.only is not None or share.part is not None
        todo = _begun(made, folder, wanted)
        with working_in(folder, alone=not in_part):
            todo = remaining(folder, todo)
            made.check_all(todo)
            progress = Progress(made, len(wanted), len(wanted) - len(todo))
            _run(made, folder, todo, where, progress)
        return finish(made, folder, progress, where.report, in_part=in_part, as_json=json)


def _wanted(made: Campaign, share: Share) -> Sequence[int]:
    if share.only is not None and share.part is not None:
        raise Failure("--only and --part: give one of them", WRONG_USE)
    if share.only is not None:
        made.values(share.only)  # raises CampaignError for a run that there is not
        return [share.only]
    try:
        return range(made.runs) if share.part is None else part_of(share.part).indices(made.runs)
    except ValueError as error:
        raise Failure(f"--part: {error}", WRONG_USE) from error


def _begun(made: Campaign, folder: Path, wanted: Sequence[int]) -> list[int]:
    """Make or check the folder, and return what remains to be done."""
    try:
        remark = begin_folder(made, folder)
    except OSError as error:
        raise Failure(f"--folder: {error.filename or folder}: {error.strerror or error}", WRONG_USE) from error
    if remark:
        status.print(f"note: {remark}", markup=False)
    return remaining(folder, wanted)


def _run(made: Campaign, folder: Path, todo: list[int], where: Where, progress: Progress) -> None:
    if not todo:
        return
    if where.scheduler is None:
        prepared(parts_of(made.rig(todo[0])))
    workers = _workers(made, folder.absolute(), len(todo), where)
    gc.freeze()  # what is loaded stays: no collection need look at it again
    stop_on_signals(_Stopping(workers, progress).stop)
    with progress.shown():
        try:
            run_campaign(made, folder, todo, workers, progress.add)
        except CampaignStopped as error:
            progress.trouble = str(error)
    if not progress.interrupted:  # a report of many runs takes its time
        interrupt_on_stop_signals()


def _workers(made: Campaign, folder: Path, most: int, where: Where) -> Workers:
    if where.scheduler is not None:
        if where.workers is not None:
            raise Failure("--workers and --scheduler: the scheduler's workers do the runs; give one of them", WRONG_USE)
        from emulator.campaign.on_dask import DaskWorkers

        return DaskWorkers(made, folder, where.scheduler)
    count = cores() if where.workers is None else where.workers
    if not 1 <= count <= 1024:
        raise Failure(f"--workers must be 1 to 1024, got {count}", WRONG_USE)
    count = min(count, most)
    threads = max(1, cores() // count)
    return LocalWorkers([WarmWorker(made, folder, threads) for _ in range(count)])


class _Stopping:
    """Stops the workers at a signal, and lets the progress know that it was not the campaign's end."""

    def __init__(self, workers: Workers, progress: Progress) -> None:
        self._workers = workers
        self._progress = progress

    def stop(self) -> None:
        self._progress.interrupted = True
        self._workers.stop()


verbs = App(name="campaign")
verbs.default(campaign)
verbs.command(again, name="again")
verbs.command(report, name="report")
