"""A campaign: what each of its runs is, as a pure function of the campaign's content and the run's index."""

from __future__ import annotations

import hashlib
import json
import math
import tomllib
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from typing import Any

from emulator.campaign.columns import check_columns
from emulator.campaign.laws import Law
from emulator.campaign.loading import CampaignError, Source, parse_settings, told_at
from emulator.campaign.placeholders import check_placeholders
from emulator.campaign.rig_keys import laid_over, path_of, with_value, with_worker
from emulator.campaign.sampling import grid_digits, unit_points
from emulator.rig.loading import Rig, rig_of_table
from emulator.tables.text_file import shortened
from emulator.tables.typed_table import Path as KeyPath
from emulator.tables.typed_table import TableError

__all__ = ["Campaign"]

_NOT_OF_THE_RUNS = ("title", "rig", "min_success", "timeout_s", "report")
_FOR_PROGRAM = "program."


class Campaign:
    """A campaign that was read and checked; raises CampaignError for one that cannot be run.

    Attributes
    ----------
    source : the texts that it is made of.
    settings : the campaign file.
    content : all that the runs depend on, as plain tables.
    id : a digest of the content.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.settings, written = parse_settings(source)
        self._base = laid_over(tomllib.loads(source.rig_text), self.settings.set)
        self.content: dict[str, Any] = {
            "campaign": {key: value for key, value in written.items() if key not in _NOT_OF_THE_RUNS},
            "rig": tomllib.loads(source.rig_text),
        }
        canonical = json.dumps(self.content, sort_keys=True, default=str)
        self.id = hashlib.blake2b(canonical.encode(), digest_size=8).hexdigest()
        self._grid = self._grid_values()
        self._check()

    @property
    def name(self) -> str:
        """The file's name without its suffix."""
        return Path(self.source.file).stem

    @cached_property
    def runs(self) -> int:
        """Number of runs."""
        return self._points * self.settings.repeats

    @cached_property
    def _points(self) -> int:
        s = self.settings
        if s.sampling == "grid":
            return math.prod(len(values) for values in self._grid)
        return s.count * (len(s.parameters) + 2 if s.sampling == "saltelli" and s.parameters else 1)

    @cached_property
    def _units(self) -> Any:
        s = self.settings
        return unit_points(s.sampling, s.count, len(s.parameters), self._seed("sampling", 0))

    def seed(self, index: int) -> int:
        """Return the seed of all that is random in a run."""
        return self._seed("run", index)

    def _seed(self, purpose: str, index: int) -> int:
        words = f"{self.id} {purpose} {index}".encode()
        return int.from_bytes(hashlib.blake2b(words, digest_size=8).digest()) >> 1

    def values(self, index: int) -> dict[str, Any]:
        """Return the value of each parameter in a run, by key."""
        if not 0 <= index < self.runs:
            raise CampaignError(f"there is no run {index}: the campaign has runs 0 to {self.runs - 1}")
        point, laws = index // self.settings.repeats, self.settings.parameters
        if self.settings.sampling == "grid":
            digits = grid_digits(point, [len(values) for values in self._grid])
            return {law.key: self._grid[k][d] for k, (law, d) in enumerate(zip(laws, digits, strict=True))}
        return {law.key: law.at(float(u)) for law, u in zip(laws, self._units[point], strict=True)}

    def rig(self, index: int, worker: int = 0) -> Rig:
        """Return the rig of a run; raises CampaignError, which names the parameter to blame."""
        table = with_value(self._base, ("run", "seed"), self.seed(index))
        values = self.values(index)
        try:
            for law in self.settings.parameters:
                for key in _rig_keys(law):
                    table = with_value(table, path_of(key), values[law.key])
            return rig_of_table(with_worker(table, worker), self._rig_file.stem, self._rig_file.parent)
        except TableError as error:
            raise self._blamed(error, index, values) from error

    def check_all(self, indices: Iterable[int]) -> None:
        """Raise CampaignError for the first of the runs whose rig cannot be used."""
        for index in indices:
            self.rig(index)

    @property
    def _rig_file(self) -> Path:
        return Path(self.source.rig_file)

    def _grid_values(self) -> list[list[Any]]:
        if self.settings.sampling != "grid":
            return []
        if not self.settings.parameters:
            raise CampaignError(f"{self.source.file}: a grid needs [[parameters]]")
        found = []
        for i, law in enumerate(self.settings.parameters):
            try:
                found.append(law.grid())
            except ValueError as error:
                raise told_at(self.source, TableError(str(error), ("parameters", i))) from error
        return found

    def _check(self) -> None:
        """Raise CampaignError for what can be found before the first run, but for the rigs of the single runs."""
        settings = self.settings
        try:
            for i, law in enumerate(settings.parameters):
                _check_keys(law, i, has_program=settings.program is not None)
            rig = self.rig(0)
            check_columns(rig, settings)
            check_placeholders(rig, settings, Path(self.source.file).parent)
        except TableError as error:
            raise told_at(self.source, error) from error
        ends = rig.run.seconds or (settings.program is not None and settings.program.ends_run)
        if not ends:
            raise CampaignError(
                f"{self.source.file}: a run would never end: give [set] run.seconds, or a [program] with ends_run"
            )
        if settings.record and not rig.links:
            raise CampaignError(f"{self.source.file}: record: this rig has no link, so no event is delivered")

    def _blamed(self, error: TableError, index: int, values: dict[str, Any]) -> CampaignError:
        """Return what is wrong with a run's rig, at the line of the campaign file that it comes from."""
        for i, law in enumerate(self.settings.parameters):
            if any(_meet(path_of(key), error.path) for key in _rig_keys(law)):
                told = f"{law.key} = {values[law.key]!r} in run {index}: {shortened(error)}"
                return told_at(self.source, TableError(told, ("parameters", i)))
        told = f"the rig of run {index}: {'.'.join(map(str, error.path))}: {shortened(error)}"
        return told_at(self.source, TableError(told, ("set", *error.path)))


def _rig_keys(law: Law) -> list[str]:
    return [key for key in (law.key, *law.also) if not key.startswith(_FOR_PROGRAM)]


def _meet(one: KeyPath, other: KeyPath) -> bool:
    """Return whether a path leads to another, or through it."""
    length = min(len(one), len(other))
    return length > 0 and one[:length] == other[:length]


def _check_keys(law: Law, i: int, *, has_program: bool) -> None:
    for key in (law.key, *law.also):
        try:
            path_of(key)
        except ValueError as error:
            raise TableError(str(error), ("parameters", i, "key")) from error
        if key.startswith(_FOR_PROGRAM) and not has_program:
            raise TableError(f"{key} is for a program under test: there is no [program]", ("parameters", i, "key"))
