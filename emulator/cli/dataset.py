"""`evstim dataset RIG --out DIR`: sequences of events with truth, for training and for tests of algorithms."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from emulator.campaign.campaign import Campaign
from emulator.campaign.dataset import Sequences, dataset_source, write_manifest
from emulator.campaign.loading import SequenceTruth
from emulator.campaign.table import check_tables, read_rows, rows_folder, working_in
from emulator.campaign.workers import remaining
from emulator.cli.campaign import Placement, Progress, begun, campaign_failures, run_remaining
from emulator.cli.checks import failures
from emulator.cli.output import (
    BAD_VERDICT,
    GOOD,
    LACKING,
    WRONG_USE,
    Failure,
    Json,
    console,
    failing,
    print_json,
    status,
)


@dataclass(frozen=True)
class Content:
    """Content of the sequences.

    Attributes
    ----------
    count
        Number of sequences.
    seconds
        Length of each, of stream time.
    seed
        Of everything random.
    vary
        TOML file with [[parameters]] and other keys of a campaign file, see docs/datasets.md. Without it sequences
        differ by their seeds.
    truth
        light, depth, flow, labels, poses, clean_events, with commas between; default: what the scene has of the
        middle four.
    rate
        Light, depth, flow and labels a second.
    format
        h5: a truth file, which readers of DSEC take for a recording; npz: the same arrays for numpy.
    """

    count: int = 100
    seconds: float = 1.0
    seed: int = 1
    vary: Path | None = None
    truth: str = ""
    rate: float = 20.0
    format: Literal["h5", "npz"] = "h5"


_CONTENT = Content()


def dataset(
    rig: str,
    /,
    *,
    out: Path,
    content: Annotated[Content, Parameter(name="*")] = _CONTENT,
    workers: int | None = None,
    scheduler: str | None = None,
    json: Json = False,
) -> int:
    """Make a data set, or the rest of it. Ctrl-C ends it with its summary; the same command continues it.

    Parameters
    ----------
    rig
        Path of a rig file, or the name of a shipped one.
    out
        Folder of the data set; made if missing.
    workers
        Processes on this machine; default: one for each core.
    scheduler
        Address of a dask.distributed scheduler whose workers make the sequences, such as tcp://10.0.0.1:8786.
    """
    with failures(), campaign_failures():
        campaign = _campaign(rig, out, content)
        check_tables()
        todo = begun(campaign, out, range(campaign.runs))
        Path(campaign.source.file).write_text(campaign.source.text)
        with working_in(out, alone=True):
            todo = remaining(out, todo)
            campaign.check_all(todo)
            _print_size(campaign, len(todo))
            progress = Progress(campaign, campaign.runs, campaign.runs - len(todo))
            run_remaining(campaign, out, todo, Placement(workers=workers, scheduler=scheduler), progress)
        rows = read_rows(rows_folder(out), progress.rows)
        with failing(LACKING, OSError, at="--out"):
            manifest = write_manifest(campaign, out, rows)
        failed = [row for row in rows if row["outcome"] != "ok"]
        if json:
            print_json({"folder": str(out), "wall_s": progress.wall_s, "run_s": progress.run_s, **manifest})
        else:
            console.print(f"{len(manifest['sequences'])} of {campaign.runs} sequences are in {out}", markup=False)
        for row in failed[:3]:
            console.print(f"sequence {row['index']}: {row['error']}", markup=False)
        if progress.trouble:
            raise Failure(f"{progress.trouble}. The same command goes on with the others", LACKING)
        if progress.interrupted:
            console.print("interrupted: the same command goes on", markup=False)
        return BAD_VERDICT if failed or progress.remaining else GOOD


def _campaign(rig: str, out: Path, content: Content) -> Campaign:
    layers = tuple(layer.strip() for layer in content.truth.split(",") if layer.strip())
    with failing(WRONG_USE, ValueError, at="--truth, --rate"):
        truth = SequenceTruth(content.rate, layers, content.format)
    if content.count < 1 or not 0 < content.seconds <= 86_400:
        raise Failure("--count must be 1 or more, and --seconds up to a day", WRONG_USE)
    sequences = Sequences(content.count, content.seconds, truth, content.seed, content.vary)
    return Campaign(dataset_source(rig, out.absolute() / "dataset.toml", sequences))


def _print_size(campaign: Campaign, sequences: int) -> None:
    rig, truth = campaign.rig(0), campaign.settings.truth
    assert truth is not None, "the campaign of a data set has a truth"
    size = truth.selection.pictures(rig)[1] * rig.run.seconds / 1e6
    text = f"{sequences} sequences remain, of at most {size:.3g} MB of truth each before compression, and their events"
    status.print(text, markup=False)
