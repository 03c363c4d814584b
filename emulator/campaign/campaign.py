"""A campaign: the rig and values of each run are a pure function of the campaign's content and the run's index.

Columns of the table, one row for each run:

index, campaign, outcome, error, success, margin, seed, KEY of each parameter
verdict, broken, sim_s, frames, steps, undersampled_share, late_us
events.*, link.NAME.*      fates and digests of the events
truth.digest               of the truth that a run writes
program.exit, program.trouble, result.*     how the program ended, and its result
machine.*                  host, wall time, version: the only columns that may differ when a run is repeated

Placeholders in the arguments of the program under test, such as {address} or {camera.sensor.threshold_on}.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from emulator.campaign.loading import (
    CampaignError,
    Settings,
    Source,
    laid_over,
    leaves,
    located,
    margin,
    parse_settings,
    path_of,
    succeeds,
    with_value,
    with_worker,
)
from emulator.campaign.sampling import Law, grid_digits, unit_points
from emulator.rig.loading import Rig, rig_of_table
from emulator.run.machine import pose_port
from emulator.run.outcome import RunResult, good, judge
from emulator.tables.toml_text import KeyPath, dotted, shortened
from emulator.tables.typed_table import TableError
from transports.registry import unknown

Row = dict[str, Any]

_OF_PROGRAM = ("program.", "result.")
_ALWAYS = ("index", "outcome", "seed", "verdict", "sim_s", "frames", "steps", "undersampled_share", "late_us")
_EVENTS = ("raised", "lost_in_pixel", "lost_at_readout", "read_out", "rate_hz")
_COUNTS, _LATENCIES = ("delivered", "dropped", "dropped_in_device"), ("p50", "p99", "max")
_LINK = (*_COUNTS, *(f"latency_{name}_us" for name in _LATENCIES))


def parameter_columns(values: Mapping[str, Any]) -> Row:
    """Return the values of the parameters as columns; a table or a list as JSON."""
    return {key: value if isinstance(value, str | int | float) else json.dumps(value) for key, value in values.items()}


def result_columns(rig: Rig, result: RunResult, digest: str) -> Row:
    """Return the columns of a run's result; `digest` is of the events that its sensor read out."""
    judgements = judge(rig.verdict, result)
    ledger = result.ledger
    row: Row = {
        "verdict": good(judgements),
        "broken": "; ".join(f"{rule.rule}: {rule.finding}" for rule in judgements if not rule.good),
        "sim_s": result.sim_seconds,
        "frames": result.frames,
        "steps": result.steps,
        "undersampled_share": result.undersampled_share,
        "late_us": float(result.lateness.worst_gap_us),
        "events.raised": ledger.raised,
        "events.lost_in_pixel": ledger.lost_in_pixel,
        "events.lost_at_readout": ledger.lost_at_readout,
        "events.read_out": ledger.read_out,
        "events.rate_hz": ledger.read_out / result.sim_seconds if result.sim_seconds else 0.0,
        "events.digest": digest,
    }
    for name, link in result.links.items():
        counts = {column: getattr(link, column) for column in _COUNTS}
        latencies = {f"latency_{column}_us": getattr(link.latency, column) for column in _LATENCIES}
        columns = {**counts, "digest": f"{link.digest:08x}", **latencies, "error": link.error or ""}
        row |= {f"link.{name}.{column}": value for column, value in columns.items()}
    return row


def judged(settings: Settings, row: Row) -> Row:
    """Return a row with its success and its margin."""
    return {**row, "success": succeeds(settings.success, row), "margin": margin(settings.success, row)}


def check_columns(rig: Rig, settings: Settings) -> None:
    """Raise TableError for a column that no row of the campaign has."""
    columns = [*_ALWAYS, *(f"events.{name}" for name in _EVENTS), *(law.key for law in settings.parameters)]
    columns += ["program.exit", "program.trouble"] if settings.program is not None else []
    columns += [f"link.{link.name}.{column}" for link in rig.links for column in _LINK]
    used: list[tuple[str, str, KeyPath, list[str]]] = []
    used += [(rule.column, rule.text, ("success",), columns) for rule in settings.success]
    reported, shown = [*columns, "success", "margin"], settings.report
    for key, names in (("columns", shown.columns), ("worst", [shown.worst]), ("labels", shown.labels)):
        used += [(name, name, ("report", key), reported) for name in names]
    for column, text, path, present in used:
        if column.startswith(_OF_PROGRAM) and column not in present and settings.program is None:
            raise TableError(f"{text!r} needs a [program]", path)
        if column not in present and not column.startswith("result."):
            raise TableError(unknown(column, present), path)


_PLACEHOLDER = re.compile(r"\{([A-Za-z_][\w.\[\]-]*)\}")
POSE_PORT = "port.poses"
_ALWAYS_PLACEHOLDERS = ("index", "seed", "folder", "result", "python", "worker")


def filled(argv: Sequence[str], values: Mapping[str, Any]) -> list[str]:
    """Return arguments with each {NAME} replaced by its value, a table or a list as JSON."""
    return [_PLACEHOLDER.sub(lambda match: _text(values[match[1]]), argument) for argument in argv]


def _text(value: Any) -> str:
    return str(value) if isinstance(value, str | int | float | Path) else json.dumps(value)


def addresses_as_placeholders(addresses: Mapping[str, str | None]) -> dict[str, str]:
    """Return {address.NAME} and {port.NAME} of each link, and {address} and {port} where there is only one."""
    placeholders: dict[str, str] = {}
    for name, address in addresses.items():
        port = (address or "").rpartition(":")[2]
        placeholders |= {f"address.{name}": address or "", f"port.{name}": port}
        if len(addresses) == 1:
            placeholders |= {"address": address or "", "port": port}
    return placeholders


def check_placeholders(rig: Rig, settings: Settings, folder: Path) -> None:
    """Raise TableError for an unknown placeholder, or for a program that is missing, seen from `folder`."""
    if settings.program is None:
        return
    names = [*_ALWAYS_PLACEHOLDERS, *(law.key for law in settings.parameters)]
    names += ["record"] if settings.record else []
    if settings.program.start == "with":
        names += addresses_as_placeholders({link.name: "" for link in rig.links})
        names += [POSE_PORT] if pose_port(rig) is not None else []
    program = settings.program.argv[0]
    can_run = os.access(folder / program, os.X_OK) if "/" in program else shutil.which(program)
    if not can_run and not _PLACEHOLDER.search(program):
        raise TableError(f"there is no program {program!r} that can be run", ("program", "argv"))
    for name in (name for argument in settings.program.argv for name in _PLACEHOLDER.findall(argument)):
        if name == "record" and not settings.record:
            raise TableError('{record} needs record = ".npz", or another suffix', ("program", "argv"))
        if name not in names:
            raise TableError(f"placeholder {unknown(name, names)}", ("program", "argv"))


_NOT_OF_THE_RUNS = ("title", "rig", "min_success", "timeout_s", "report")
_FOR_PROGRAM = "program."


class Campaign:
    """A campaign, read and checked; raises CampaignError for one that cannot be run.

    Attributes
    ----------
    source : the texts that it is made of.
    settings : the campaign file.
    content : all inputs of the runs, as plain tables.
    id : a digest of the content.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.settings, written = parse_settings(source)
        rig = tomllib.loads(source.rig_text)
        self._base = laid_over(rig, written.get("set", {}))
        self.content: dict[str, Any] = {
            "campaign": {key: value for key, value in written.items() if key not in _NOT_OF_THE_RUNS},
            "rig": rig,
        }
        self.id = _digest(self.content)
        # What is written of a run does not change it.
        runs = {key: value for key, value in self.content["campaign"].items() if key != "truth"}
        self._seeds = _digest(self.content | {"campaign": runs})
        try:
            self._grid = self._grid_values()
            self._check()
        except TableError as error:
            raise located(source, error) from error

    @property
    def name(self) -> str:
        """The file's name without its suffix."""
        return Path(self.source.file).stem

    @cached_property
    def runs(self) -> int:
        """Number of runs."""
        s = self.settings
        if s.sampling == "grid":
            return math.prod(len(values) for values in self._grid) * s.repeats
        return s.count * (len(s.parameters) + 2 if s.sampling == "saltelli" and s.parameters else 1) * s.repeats

    @cached_property
    def _units(self) -> Any:
        s = self.settings
        return unit_points(s.sampling, s.count, len(s.parameters), self._seed("sampling", 0))

    def seed(self, index: int) -> int:
        """Return the seed of everything random in a run."""
        return self._seed("run", index)

    def _seed(self, purpose: str, index: int) -> int:
        words = f"{self._seeds} {purpose} {index}".encode()
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
        """Return the rig of a run; raises CampaignError, which names the parameter at fault."""
        table, values = self._base, self.values(index)
        try:
            for law in self.settings.parameters:
                for key in _rig_keys(law):
                    table = with_value(table, path_of(key), values[law.key])
            table = with_worker(with_value(table, ("run", "seed"), self.seed(index)), worker)
            rig = rig_of_table(table, self._rig_file.stem, self._rig_file.parent)
        except TableError as error:
            raise self._error_of_run(error, index, values) from error
        try:
            self._check_run(rig)
        except TableError as error:
            raise located(self.source, error) from error
        return rig

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
            raise TableError("a grid needs [[parameters]]", ("sampling",))
        grid = []
        for i, law in enumerate(self.settings.parameters):
            try:
                grid.append(law.grid())
            except ValueError as error:
                raise TableError(str(error), ("parameters", i)) from error
        return grid

    def _check(self) -> None:
        """Check everything but the rigs of the single runs, before the first run; raises TableError, CampaignError."""
        _check_keys(self.settings)
        rig = self.rig(0)
        check_columns(rig, self.settings)
        check_placeholders(rig, self.settings, Path(self.source.file).parent)

    def _check_run(self, rig: Rig) -> None:
        """Raise TableError where the run of a rig would never end, or cannot be recorded, or lacks its truth."""
        settings = self.settings
        if not round(rig.run.seconds * 1e9) and not (settings.program is not None and settings.program.ends_run):
            message = "a run would never end: give [set] run.seconds, or a [program] with ends_run"
            raise TableError(message, ("set", "run", "seconds"))
        if settings.truth is not None:
            settings.truth.check(rig)
        if settings.record and not rig.links:
            raise TableError("this rig has no link, so no event is delivered", ("record",))

    def _error_of_run(self, error: TableError, index: int, values: dict[str, Any]) -> CampaignError:
        """Return the error in a run's rig, with the line of the campaign file that causes it."""
        for i, law in enumerate(self.settings.parameters):
            if any(_meet(path_of(key), error.path) for key in _rig_keys(law)):
                message = f"{law.key} = {values[law.key]!r} in run {index}: {shortened(error)}"
                return located(self.source, TableError(message, ("parameters", i)))
        message = f"the rig of run {index}: {'.'.join(map(str, error.path))}: {shortened(error)}"
        return located(self.source, TableError(message, ("set", *error.path)))


def _digest(content: Mapping[str, Any]) -> str:
    canonical = json.dumps(content, sort_keys=True, default=str)
    return hashlib.blake2b(canonical.encode(), digest_size=8).hexdigest()


def _rig_keys(law: Law) -> list[str]:
    return [key for key in (law.key, *law.also) if not key.startswith(_FOR_PROGRAM)]


def _meet(path: KeyPath, other: KeyPath) -> bool:
    """Return whether a path leads to another, or through it."""
    length = min(len(path), len(other))
    return length > 0 and path[:length] == other[:length]


_SEED = ("run", "seed")
_OWN_SEED = "each run has a seed of its own, see `seed` and `repeats`: remove this key"


def _check_keys(settings: Settings) -> None:
    """Raise TableError for a key of [[parameters]] or [set] that would have no effect."""
    earlier = dict.fromkeys(leaves(settings.set), "in [set]")
    if _SEED in earlier:
        raise TableError(_OWN_SEED, ("set", *_SEED))
    for i, law in enumerate(settings.parameters):
        if settings.sampling != "grid" and getattr(law, "steps", None):
            raise TableError('it is for sampling = "grid" alone: remove this key', ("parameters", i, "steps"))
        for key in (law.key, *law.also):
            at: KeyPath = ("parameters", i, "key" if key == law.key else "also")
            try:
                path = path_of(key)
            except ValueError as error:
                raise TableError(str(error), at) from error
            if key.startswith(_FOR_PROGRAM) and settings.program is None:
                raise TableError(f"{key} is for a program under test: there is no [program]", at)
            if path == _SEED:
                raise TableError(_OWN_SEED, at)
            for other, place in earlier.items():
                if other[: len(path)] == path:
                    raise TableError(f"{key} replaces {dotted(other)}, given {place}", at)
            earlier[path] = "by an earlier parameter"
