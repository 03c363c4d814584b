"""A campaign run to its end: what remains to be done is found, each row is written as it comes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from emulator.campaign.campaign import Campaign
from emulator.campaign.columns import Row
from emulator.campaign.folder import rows_folder
from emulator.campaign.one_run import CampaignStopped
from emulator.campaign.table import done_rows, write_row

__all__ = ["Part", "Workers", "part_of", "remaining", "run_campaign"]


class Workers(Protocol):
    """What does runs: processes here, or a cluster."""

    def rows(self, indices: Iterable[int]) -> Iterator[Row]:
        """Do the runs and give their rows as they come, in any order; raises CampaignStopped."""

    def stop(self) -> None:
        """Begin no further run and give up those at hand; for a signal handler."""


@dataclass(frozen=True)
class Part:
    """The runs of one job of a job array: every `of`-th, from `number` - 1 on."""

    number: int
    of: int

    def indices(self, runs: int) -> range:
        """Return the indices of the part's runs."""
        return range(self.number - 1, runs, self.of)


def part_of(text: str) -> Part:
    """Return a part written as "3/10", the third of ten; raises ValueError."""
    found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise ValueError(f"expected I/N with I from 1 to N, such as 3/10, got {text!r}")
    return Part(int(found[1]), int(found[2]))


def remaining(folder: Path, wanted: Iterable[int]) -> list[int]:
    """Return which of the wanted runs have no row yet."""
    done = done_rows(rows_folder(folder))
    return [index for index in wanted if index not in done]


def run_campaign(
    campaign: Campaign, folder: Path, indices: Iterable[int], workers: Workers, on_row: Callable[[Row], None]
) -> int:
    """Do runs, write each row when it comes, and return how many came; raises CampaignStopped.

    Rows that were written stay, whatever happens.
    """
    count = 0
    rows = workers.rows(indices)
    try:
        for row in rows:
            _write(folder, row, campaign)
            count += 1
            on_row(row)
    finally:
        close = getattr(rows, "close", None)  # a generator stops its workers then
        if close is not None:
            close()
    return count


def _write(folder: Path, row: Row, campaign: Campaign) -> None:
    try:
        write_row(rows_folder(folder), row)
    except OSError as error:
        raise CampaignStopped(
            f"{folder}: {error.strerror or error}: the row of run {row['index']} of {campaign.name} was not written"
        ) from error
