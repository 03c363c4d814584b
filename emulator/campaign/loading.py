"""Campaign files: a rig, what varies in it, how it is sampled, and when a run is a success.

    rig = "checkerboard"                  a name, or a path from this file's folder
    sampling, count, repeats, seed        where the runs lie
    success = ["verdict", "program", "events.read_out > 1000"]
    [set]                                 tables of a rig, laid over the rig's own
    [[parameters]]                        key, kind = "uniform" | "log-uniform" | "normal" | "integers" | "list"
    [program]                             the program under test
    [report]                              what the report shows

A mistake raises CampaignError, which tells the file, the line, the key, what is wrong and what would be right.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from emulator.campaign.laws import LAWS, Law
from emulator.campaign.rig_keys import text_of
from emulator.campaign.success import SuccessRule, parse_rule
from emulator.campaign.tables import Program, Settings
from emulator.rig.loading import find_rig, parse_rig, read_rig
from emulator.tables.text_file import TextFileError, read_text, shortened
from emulator.tables.toml_text import TomlError, line_of, read_toml
from emulator.tables.typed_table import Path as KeyPath
from emulator.tables.typed_table import TableError, convert, convert_kind, field_types, unknown

__all__ = ["CampaignError", "Source", "load_source", "parse_settings", "told_at"]

_MOST_BYTES = 1 << 22
T = TypeVar("T")


class CampaignError(Exception):
    """A campaign file cannot be used; the message is for its author."""


@dataclass(frozen=True)
class Source:
    """The texts that a campaign is made of: all that a worker elsewhere needs.

    Attributes
    ----------
    file, text : of the campaign.
    rig_file, rig_text : of its rig.
    """

    file: str
    text: str
    rig_file: str
    rig_text: str


def load_source(file: Path) -> Source:
    """Return the texts of a campaign file and its rig; raises CampaignError and RigError."""
    file = file.absolute()
    if not file.exists():
        raise CampaignError(f"{file}: no such file: give the path of a campaign file (docs/campaigns.md has one)")
    try:
        text = read_text(file, _MOST_BYTES)
    except TextFileError as error:
        raise CampaignError(f"{file}: {error}") from error
    named = str(_table_of(text, str(file)).get("rig", ""))
    if not named:
        raise CampaignError(f"{file}: 'rig' is missing: the name of a shipped rig, or the path of a rig file")
    beside = file.parent / named
    rig = beside if beside.is_file() else find_rig(named)
    rig_text = read_rig(rig)
    parse_rig(rig_text, str(rig), rig.stem)  # its own mistakes are told as `evstim check` tells them
    return Source(str(file), text, str(rig.absolute()), rig_text)


def _table_of(text: str, file: str) -> dict[str, Any]:
    try:
        return read_toml(text)
    except TomlError as error:
        raise CampaignError(error.at(file)) from error


def parse_settings(source: Source) -> tuple[Settings, dict[str, Any]]:
    """Return a campaign file as its types, and as it is written; raises CampaignError."""
    table = _table_of(source.text, source.file)
    try:
        return _settings(table), table
    except TableError as error:
        raise told_at(source, error) from error


def told_at(source: Source, error: TableError) -> CampaignError:
    """Return the mistake with its file, line and key."""
    line = line_of(source.text, error.path)
    at = f"{source.file}, line {line}" if line else source.file
    key = text_of(error.path)[:200]
    return CampaignError(f"{at}: {key}: {shortened(error)}" if key else f"{at}: {shortened(error)}")


def _settings(table: dict[str, Any]) -> Settings:
    known = list(field_types(Settings))
    for key in table:
        if key not in known:
            raise TableError(unknown(key, known), (key,))
    made: dict[str, Any] = {
        "parameters": _parameters(table.get("parameters", [])),
        "success": _rules(table.get("success", [])),
    }
    if "program" in table:
        made["program"] = convert(table["program"], Program, ("program",))
    settings = convert({key: value for key, value in table.items() if key not in made}, Settings)
    return _with(settings, made)


def _with(settings: Settings, made: dict[str, Any]) -> Settings:
    return Settings(**{**{name: getattr(settings, name) for name in field_types(Settings)}, **made})


def _parameters(tables: object) -> tuple[Law, ...]:
    if not isinstance(tables, list):
        raise TableError("expected [[parameters]] tables", ("parameters",))
    laws = tuple(convert_kind(table, LAWS, ("parameters", i)) for i, table in enumerate(tables))
    _check_apart(laws)
    return laws


def _check_apart(laws: tuple[Law, ...]) -> None:
    """Raise TableError for a key that two parameters give, or that no rig can have."""
    taken: set[str] = set()
    for i, law in enumerate(laws):
        for key in (law.key, *law.also):
            path: KeyPath = ("parameters", i, "key" if key == law.key else "also")
            if key in taken:
                raise TableError(f"{key!r} is given by an earlier parameter as well", path)
            taken.add(key)


def _rules(told: object) -> tuple[SuccessRule, ...]:
    if not isinstance(told, list):
        raise TableError("expected a list of rules", ("success",))
    try:
        return tuple(parse_rule(one) for one in told)
    except ValueError as error:
        raise TableError(str(error), ("success",)) from error
