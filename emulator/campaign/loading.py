"""Campaign files: a rig, its varied parameters, their sampling, and the rules of success.

    rig = "checkerboard"                  a name, or a path from this file's folder
    sampling, count, repeats, seed        where the runs lie
    success = ["verdict", "program", "events.read_out > 1000"]
    [set]                                 tables of a rig, laid over the rig's own
    [[parameters]]                        key, kind = "uniform" | "log-uniform" | "normal" | "integers" | "list"
    [program]                             the program under test
    [truth]                               the truth that each run writes
    [report]                              content of the report

A mistake raises CampaignError, whose message contains the file, the line, the key, the error and the allowed values.

The tables of a campaign file are frozen types. Keys of a rig are dotted text, such as "faults[0].rate"; their values
replace those in the tables of a rig.

A run is a success by the rig's verdict, the program's exit and rules such as "result.error < 0.05". The share of
successes has a confidence interval.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta
from scipy.stats import binomtest

from emulator.campaign.sampling import LAWS, Law, Sampling
from emulator.rig.loading import Rig, find_rig, parse_rig, read_rig
from emulator.run.truth.file import LAYERS
from emulator.run.truth.source import ABSENT, TruthRefused, TruthSelection, check_truth
from emulator.tables.toml_text import (
    KeyPath,
    TextFileError,
    TomlError,
    dotted,
    read_text,
    read_toml,
    shortened,
)
from emulator.tables.typed_table import TableError, convert, convert_kind, field_types
from firmware_protocol.bounds import Share, check_bounds
from transports.registry import unknown

_COMPARE: dict[str, Callable[[Any, Any], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
_WORDS = {"verdict": ("verdict", "==", True), "program": ("program.exit", "==", 0)}


@dataclass(frozen=True)
class SuccessRule:
    """A column of a row, compared with a value; `text`: the rule as in the campaign file."""

    text: str
    column: str
    op: str
    value: float | str | bool

    def kept_by(self, row: Mapping[str, Any]) -> bool:
        """Return whether a row keeps the rule; a row without a value there does not."""
        value = row.get(self.column)
        if value is None or isinstance(value, str) != isinstance(self.value, str):
            return False
        return _COMPARE[self.op](value, self.value)


def parse_rule(text: object) -> SuccessRule:
    """Return a rule from its text in a campaign file; raises ValueError."""
    if not isinstance(text, str):
        raise ValueError(f'expected text such as "result.error < 0.05", got {text!r}')
    if text in _WORDS:
        return SuccessRule(text, *_WORDS[text])
    parts = text.split(maxsplit=2)
    if len(parts) != 3 or parts[1] not in _COMPARE:
        raise ValueError(
            f'expected "verdict", "program" or "COLUMN OP VALUE" with one of {" ".join(_COMPARE)}, got {text!r}'
        )
    column, op, value = parts
    rule = SuccessRule(text, column, op, _value(value))
    if op in ("<", "<=", ">", ">=") and (isinstance(rule.value, str | bool) or math.isnan(rule.value)):
        raise ValueError(f"{op} needs a number, got {value!r}")
    return rule


def _value(text: str) -> float | str | bool:
    if text in ("true", "false"):
        return text == "true"
    try:
        return float(text)
    except ValueError:
        return text.strip("\"'")


def succeeds(rules: Sequence[SuccessRule], row: Mapping[str, Any]) -> bool:
    """Return whether a run ended normally and kept every rule; without rules, whether its verdict is good."""
    rules = rules or (parse_rule("verdict"),)
    return row["outcome"] == "ok" and all(rule.kept_by(row) for rule in rules)


def margin(rules: Sequence[SuccessRule], row: Mapping[str, Any]) -> float | None:
    """Return the distance of a row to its nearest limit, as a share of that rule's value; below 0 the rule is broken.

    None without a rule that compares numbers by size.
    """
    return min((value for rule in rules if (value := _margin(rule, row)) is not None), default=None)


def _margin(rule: SuccessRule, row: Mapping[str, Any]) -> float | None:
    value, limit = row.get(rule.column), rule.value
    if rule.op in ("==", "!=") or isinstance(value, str | bool) or value is None or isinstance(limit, str):
        return None
    distance = float(value) - limit if rule.op.startswith(">") else limit - float(value)
    return distance / (abs(limit) or 1.0)


@dataclass(frozen=True)
class Proportion:
    """Successes among runs, with the Wilson interval of their probability."""

    successes: int
    runs: int
    low: float
    high: float

    @property
    def share(self) -> float:
        """Successes divided by runs; 0 without a run."""
        return self.successes / self.runs if self.runs else 0.0

    def __str__(self) -> str:
        return f"{self.successes} of {self.runs} ({self.share:.1%}; 95 % interval {self.low:.1%} to {self.high:.1%})"


def proportion(successes: int, runs: int) -> Proportion:
    """Return the share of successes with its Wilson interval of 95 %."""
    if not runs:
        return Proportion(0, 0, 0.0, 1.0)
    interval = binomtest(successes, runs).proportion_ci(0.95, method="wilson")
    return Proportion(successes, runs, float(interval.low), float(interval.high))


@dataclass(frozen=True)
class Program:
    """The program under test, started once for each run.

    Attributes
    ----------
    argv : Program and arguments. Placeholders: {index}, {seed}, {folder} (the run's own, for its files), {result} (the
        JSON file that it may write), {record} (the delivered events), {python}, {address} (of the only link),
        {address.NAME}, {port}, {port.NAME}, and {KEY} for the value of a parameter.
    start : "with": when the links of the run are open; "after": when the run is over.
    ends_run : whether the run ends when the program does; only a program that starts with the run can.
    grace_s : How long the program may take to end after the run has; then it is stopped. Started after the run: how
        long it may take at all.
    """

    argv: tuple[str, ...]
    start: Literal["with", "after"] = "with"
    ends_run: bool = False
    grace_s: Annotated[float, Meta(ge=0, le=1e6)] = 10.0

    def __post_init__(self) -> None:
        if not self.argv:
            raise ValueError("argv must name a program")
        if self.ends_run and self.start == "after":
            raise ValueError('ends_run is for start = "with": a program that starts after the run cannot end it')
        check_bounds(self)


FLOW_HZ = 10
"""Maps of optical flow a second in a sequence of DSEC, each of the displacement until the next one."""
_MOST_DSEC_S = 4294.0


@dataclass(frozen=True)
class SequenceTruth:
    """Truth that each run writes with its events, as a sequence of a data set.

    Attributes
    ----------
    rate_hz : light, depth, flow and labels a second.
    layers : of "light", "depth", "flow", "labels", "poses" and "clean_events"; by default depth, flow, labels and
        poses, as far as the scene has them.
    format : "h5": a truth file, which readers of DSEC take for a recording; "npz": the same arrays for numpy; "dsec":
        the folder of a sequence of DSEC, with a truth file beside what it has a place for.
    """

    rate_hz: Annotated[float, Meta(gt=0, le=1e6)] = 20.0
    layers: tuple[str, ...] = ()
    format: Literal["h5", "npz", "dsec"] = "h5"

    def __post_init__(self) -> None:
        check_bounds(self)
        for layer in self.layers:
            if layer not in LAYERS:
                raise ValueError(unknown(layer, LAYERS))
        if self.format == "dsec" and self.rate_hz % FLOW_HZ:
            raise ValueError(f"rate_hz must be a multiple of DSEC's {FLOW_HZ} flows a second, got {self.rate_hz:g}")
        if self.format == "dsec" and self.layers and not {"flow", "labels"} <= {*self.layers}:
            raise ValueError('layers: format "dsec" needs "flow" and "labels", which show where flow is known')

    def check(self, rig: Rig) -> None:
        """Raise TableError where a run of a rig cannot have this truth."""
        try:
            check_truth(rig, self.selection)
        except TruthRefused as error:
            raise TableError(str(error), ("truth",)) from error
        lacking, reason = ABSENT.get(rig.scene.kind, ((), ""))
        if missing := [layer for layer in self.layers if layer in lacking]:
            raise TableError(f"this scene has no {', '.join(missing)} ({reason})", ("truth", "layers"))
        if rig.run.step_us * self.rate_hz > 1e6 + 1e-3:
            most_us = math.floor(1e6 / self.rate_hz)
            raise TableError(f"{self.rate_hz:g} needs run.step_us of at most {most_us}", ("truth", "rate_hz"))
        if self.format == "dsec" and rig.run.seconds > _MOST_DSEC_S:
            message = f"at most {_MOST_DSEC_S:g} with format dsec: its times have 32 bits"
            raise TableError(message, ("set", "run", "seconds"))

    @property
    def selection(self) -> TruthSelection:
        """Content of the truth of each run."""
        return TruthSelection(rate_hz=self.rate_hz, layers=self.layers or ("depth", "flow", "labels", "poses"))


@dataclass(frozen=True)
class Plots:
    """Content of the report.

    Attributes
    ----------
    columns : Columns whose sensitivity is reported; by default success, the margin, the event rate and the numbers that
        the program gives.
    worst : the column that orders the worst runs; by default the margin.
    worst_is : whether the lowest or the highest values of it are the worst.
    labels : names of columns and parameters in the report, with their units: "result.vertical_m_s" = "touchdown, m/s".
    """

    columns: tuple[str, ...] = ()
    worst: str = "margin"
    worst_is: Literal["lowest", "highest"] = "lowest"
    labels: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Settings:
    """A campaign file but its rig.

    Attributes
    ----------
    rig : name of a shipped rig, or path of a rig file, absolute or from the campaign's folder.
    title : purpose of the campaign, in one sentence.
    sampling : how the values of the parameters are chosen.
    count : number of points; with "saltelli" of base points; a grid has as many as it has.
    repeats : runs of each point, each with a seed of its own.
    seed : seed of everything random in the campaign.
    success : rules of a successful run: "verdict", "program" (it ends with 0), and rules "COLUMN OP VALUE".
    min_success : share of successes below which `evstim campaign` ends with 1.
    timeout_s : time after which a run is given up.
    record : suffix of each run's recording of the delivered events, such as ".npz"; none by default.
    truth : truth that each run writes with its events; none by default.
    parameters : sampled parameters.
    program : the program under test.
    report : content of the report.
    set : tables of a rig, laid over the rig's own.
    """

    rig: str
    title: str = ""
    sampling: Sampling = "sobol"
    count: int = 0
    repeats: Annotated[int, Meta(ge=1, le=1_000_000)] = 1
    seed: int = 1
    success: tuple[SuccessRule, ...] = ()
    min_success: Share = 0.0
    timeout_s: Annotated[float, Meta(gt=0, le=1e7)] = 3600.0
    record: str = ""
    truth: SequenceTruth | None = None
    parameters: tuple[Law, ...] = ()
    program: Program | None = None
    report: Plots = field(default_factory=Plots)
    set: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.sampling == "grid" and self.count:
            raise ValueError("count is for samples: a grid has as many points as its values; see repeats")
        if self.sampling != "grid" and not 1 <= self.count <= 10_000_000:
            raise ValueError(f"count must be 1 to 10000000, got {self.count}")
        check_bounds(self)
        if self.record and not self.record.startswith("."):
            raise ValueError(f'record must be a suffix such as ".npz", got {self.record!r}')


_PART = re.compile(r"([A-Za-z_][A-Za-z0-9_-]*)((?:\[\d+\])*)")
_WORKER = "{worker}"


def path_of(key: str) -> KeyPath:
    """Return a dotted key as a path; raises ValueError."""
    path: KeyPath = ()
    for part in key.split("."):
        if not (match := _PART.fullmatch(part)):
            raise ValueError(f'key must be like "camera.sensor.threshold_on" or "faults[0].rate", got {key!r}')
        path = (*path, match[1], *(int(n) for n in re.findall(r"\d+", match[2])))
    return path


def with_value(table: Any, path: KeyPath, value: Any, at: KeyPath = ()) -> Any:
    """Return tables with one value set, and missing tables on its path made; the argument is not changed."""
    if not path:
        return value
    head, remaining = path[0], path[1:]
    if isinstance(head, int):
        if not isinstance(table, list) or head >= len(table):
            count = len(table) if isinstance(table, list) else 0
            raise TableError(f"{dotted((*at, head))} is not in the rig, which has {count} of them", (*at, head))
        return [*table[:head], with_value(table[head], remaining, value, (*at, head)), *table[head + 1 :]]
    table = {} if table is None else table
    if not isinstance(table, dict):
        raise TableError(f"{dotted(at)} is no table", at)
    return {**table, head: with_value(table.get(head), remaining, value, (*at, head))}


def leaves(table: Mapping[str, Any], at: KeyPath = ()) -> Iterator[KeyPath]:
    """Yield the path of each value in tables."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from leaves(value, (*at, key))
        else:
            yield (*at, key)


def laid_over(table: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return tables with those of `over` laid over them: tables are merged, everything else is replaced."""
    merged = dict(table)
    for key, value in over.items():
        old = merged.get(key)
        merged[key] = laid_over(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged


def with_worker(table: Any, worker: int) -> Any:
    """Return tables in whose texts {worker} is the worker's number: a bus for each, for example."""
    if isinstance(table, dict):
        return {key: with_worker(value, worker) for key, value in table.items()}
    if isinstance(table, list):
        return [with_worker(value, worker) for value in table]
    return table.replace(_WORKER, str(worker)) if isinstance(table, str) else table


_MOST_BYTES = 1 << 22


class CampaignError(Exception):
    """A campaign file cannot be used; the message is for its author."""


@dataclass(frozen=True)
class Source:
    """Texts of a campaign and its rig, complete for a worker on another machine.

    Attributes
    ----------
    file, text : of the campaign.
    rig_file, rig_text : of its rig.
    author_file, author_text : of what the author of a data set wrote beside `OPTIONS`; "": no data set.
    """

    file: str
    text: str
    rig_file: str
    rig_text: str
    author_file: str = ""
    author_text: str = ""


def load_source(file: Path) -> Source:
    """Return the texts of a campaign file and its rig; raises CampaignError and RigError."""
    file = file.absolute()
    if not file.exists():
        raise CampaignError(f"{file}: no such file: give the path of a campaign file (docs/campaigns.md has one)")
    text = campaign_text(file)
    named = str(table_of(text, str(file)).get("rig", ""))
    if not named:
        raise CampaignError(f"{file}: 'rig' is missing: the name of a shipped rig, or the path of a rig file")
    beside = file.parent / named
    rig = beside if beside.is_file() else find_rig(named)
    rig_text = read_rig(rig)
    parse_rig(rig_text, str(rig), rig.stem)  # errors of the rig itself, as in `evstim check`
    return Source(str(file), text, str(rig.absolute()), rig_text)


def campaign_text(file: Path) -> str:
    """Return the text of a campaign file, or of a part of one; raises CampaignError."""
    try:
        return read_text(file, _MOST_BYTES)
    except (TextFileError, OSError) as error:
        raise CampaignError(f"{file}: {error}") from error


def table_of(text: str, file: str) -> dict[str, Any]:
    """Return the tables of a campaign's text; raises CampaignError, which names `file`."""
    try:
        return read_toml(text)
    except TomlError as error:
        raise CampaignError(error.at(file)) from error


def parse_settings(source: Source) -> tuple[Settings, dict[str, Any]]:
    """Return a campaign file as its types, and as plain tables; raises CampaignError."""
    table = table_of(source.text, source.file)
    try:
        return _settings(table), table
    except TableError as error:
        raise located(source, error) from error


OPTIONS: Mapping[KeyPath, str] = {
    ("count",): "--count",
    ("seed",): "--seed",
    ("set", "run", "seconds"): "--seconds",
    ("truth",): "a data set",
    ("truth", "layers"): "--truth",
    ("truth", "rate_hz"): "--rate",
    ("truth", "format"): "--format",
}
"""Options of `evstim dataset` by the keys of the campaign that it makes."""


def located(source: Source, error: TableError) -> CampaignError:
    """Return the mistake with its file, line and key; in the campaign of a data set with its option."""
    file, text = source.file, source.text
    if source.author_file:
        file, text = source.author_file, source.author_text
        if error.path in OPTIONS:
            return CampaignError(f"{OPTIONS[error.path]}: {shortened(error)}")
    return CampaignError(error.at(file, text))


def _settings(table: dict[str, Any]) -> Settings:
    keys = list(field_types(Settings))
    for key in table:
        if key not in keys:
            raise TableError(unknown(key, keys), (key,))
    values: dict[str, Any] = {
        "parameters": parse_laws(table.get("parameters", [])),
        "success": _rules(table.get("success", [])),
    }
    if "program" in table:
        values["program"] = convert(table["program"], Program, ("program",))
    settings = convert({key: value for key, value in table.items() if key not in values}, Settings)
    return Settings(**{**{name: getattr(settings, name) for name in field_types(Settings)}, **values})


def parse_laws(tables: object) -> tuple[Law, ...]:
    """Return [[parameters]] as laws; raises TableError."""
    if not isinstance(tables, list):
        raise TableError("expected [[parameters]] tables", ("parameters",))
    return tuple(convert_kind(table, LAWS, ("parameters", i)) for i, table in enumerate(tables))


def _rules(rules: object) -> tuple[SuccessRule, ...]:
    if not isinstance(rules, list):
        raise TableError("expected a list of rules", ("success",))
    try:
        return tuple(parse_rule(rule) for rule in rules)
    except ValueError as error:
        raise TableError(str(error), ("success",)) from error
