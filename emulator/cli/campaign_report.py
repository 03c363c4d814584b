"""`evstim campaign report FILE`: table and report of the runs that are done, without doing any."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from emulator.campaign.campaign import Campaign
from emulator.campaign.folder import check_folder, rows_folder
from emulator.campaign.loading import load_source
from emulator.campaign.table import check_tables, done_rows
from emulator.cli.campaign_output import Progress, campaign_failures, finish
from emulator.cli.failures import failures
from emulator.cli.output import WRONG_USE, Failure

__all__ = ["report"]


def report(
    file: Path,
    /,
    *,
    folder: Path | None = None,
    to: Path | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Write the report of the runs that are done; also while the campaign goes on.

    Parameters
    ----------
    file
        The campaign.
    folder
        Of the campaign; default: beside FILE, its name without .toml.
    to
        Folder for the report; default: the campaign's.
    json
        Print one JSON object as the last line on stdout.
    """
    with failures(), campaign_failures():
        made = Campaign(load_source(file))
        check_tables()
        here = folder or file.with_suffix("")
        check_folder(made, here)
        done = len(done_rows(rows_folder(here)))
        if not done:
            raise Failure(f"{here}: no run of {made.name} is done", WRONG_USE)
        return finish(made, here, Progress(made, done, done), to or here, in_part=False, as_json=json)
