"""`evstim campaign again FILE INDEX`: one run of a campaign once more, recorded."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from emulator.campaign.campaign import Campaign
from emulator.campaign.columns import Row
from emulator.campaign.folder import rows_folder
from emulator.campaign.loading import load_source
from emulator.campaign.one_run import Place, run_row
from emulator.campaign.table import check_tables, done_rows, read_row
from emulator.cli.campaign_output import campaign_failures
from emulator.cli.failures import failures
from emulator.cli.output import BAD_VERDICT, GOOD, WRONG_USE, Failure, console, print_json
from emulator.cli.preparing import prepared
from emulator.cli.recording_paths import check_recording
from emulator.cli.signals import interrupt_on_stop_signals
from emulator.run.kernels import parts_of

__all__ = ["again"]


def again(
    file: Path,
    index: int,
    /,
    *,
    record: Path | None = None,
    folder: Path | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Do one run of a campaign once more, and compare it with its row.

    Exit code 1 tells that events differ from those of the row.

    Parameters
    ----------
    file
        The campaign.
    index
        The run, from 0.
    record
        Write what the links delivered to this file; its suffix tells the format.
    folder
        Of the campaign; default: beside FILE, its name without .toml.
    json
        Print one JSON object as the last line on stdout.
    """
    with failures(), campaign_failures():
        campaign = Campaign(load_source(file))
        check_tables()
        rig = campaign.rig(index)
        if record is not None:
            if not rig.links:
                raise Failure("--record: this rig has no link, so no event is delivered", WRONG_USE)
            check_recording("--record", record)
        before = _row_before(campaign, folder or file.with_suffix(""), index)
        if before is None:
            prepared(parts_of(rig))
        interrupt_on_stop_signals()
        with tempfile.TemporaryDirectory(prefix="evstim-") as place:
            row = run_row(campaign, index, Place(Path(place), record=record), lambda _: None)
    different = None if before is None else _different(before, row)
    if json:
        print_json({"row": row, "different": different})
    else:
        _print(row, different)
    return BAD_VERDICT if different else GOOD


def _row_before(campaign: Campaign, folder: Path, index: int) -> Row | None:
    rows = rows_folder(folder)
    if index not in done_rows(rows):
        return None
    row = read_row(rows, index)
    return row if row["campaign"] == campaign.id else None


def _different(before: Row, now: Row) -> list[str]:
    """Return the columns of events that differ: counts and digests."""
    names = [name for name in before if name.startswith("events.") or name.endswith(".digest")]
    return [name for name in [*names, "outcome"] if before[name] != now.get(name)]


def _print(row: Row, different: list[str] | None) -> None:
    for name, value in row.items():
        console.print(f"{name}: {value}", markup=False)
    if different is None:
        console.print("there is no row of this run to compare with", markup=False)
    elif different:
        console.print(f"DIFFERENT from the row of the campaign: {', '.join(different)}", markup=False)
    else:
        console.print("equal to the row of the campaign: all counts and digests of events", markup=False)
