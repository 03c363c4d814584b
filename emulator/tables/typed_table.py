"""Conversion of a table of a rig file to a frozen dataclass, with exact messages of errors.

Tables within tables are dataclasses again, or lists of them. Where several kinds of table may stand, the annotation is
a union of dataclasses with a class attribute `kind`, and the table's own `kind` selects one. msgspec converts and
checks plain values; unknown keys, missing ones and the path of the key at fault are found here. A dataclass that
refuses a value in its `__post_init__` starts its message with the key's name.

Files that a rig names are found beside the rig file, not in the folder of the command. A dataclass of a rig marks such
a key by the type `RigFile`.
"""

from __future__ import annotations

import dataclasses
import os
import re
import types
import typing
from collections.abc import Callable, Collection, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, NewType, TypeVar

import msgspec
from msgspec import Meta

from emulator.tables.toml_text import KeyPath, dotted, line_of, shortened
from transports.registry import unknown

T = TypeVar("T")

_AT = re.compile(r" - at `\$(.*)`$")
_INDEX = re.compile(r"\[(\d+)\]")
_NUMBERS = {int: "a whole number", float: "a number"}
_UNITS = ("ns", "us", "ms", "s", "hz", "px", "um", "mm", "m", "deg", "bytes")  # ends of keys


class TableError(Exception):
    """A value in a table is wrong; `path` leads to the key."""

    def __init__(self, message: str, path: KeyPath) -> None:
        super().__init__(message)
        self.path = path

    def at(self, file: str, text: str) -> str:
        """Return the message with the file, and with line and key where its text has them."""
        line = line_of(text, self.path)
        place = f"{file}, line {line}" if line else file
        return ": ".join(part for part in (place, dotted(self.path)[:200], shortened(self)) if part)


def convert(table: object, target: type[T], path: KeyPath = ()) -> T:
    """Return `table` as a `target`, a dataclass; raises TableError."""
    if not isinstance(table, dict):
        raise TableError(f"expected a table, got {table!r}", path)
    types = field_types(target)
    choices = {key: typing.get_args(of) for key, of in types.items() if typing.get_origin(of) is Literal}
    for key, value in table.items():
        if key not in types:
            raise TableError(unknown(key, list(types)), (*path, key))
        if isinstance(value, str) and value not in choices.get(key, (value,)):
            raise TableError(_unknown_choice(key, value, choices), (*path, key))
    values = {key: _value(value, types[key], (*path, key)) for key, value in table.items()}
    for field in dataclasses.fields(target):  # type: ignore[arg-type]
        is_optional = field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING
        if field.name not in values and not is_optional:
            raise TableError(f"{field.name!r} is missing", path)
    try:
        return target(**values)
    except ValueError as error:
        first_word = re.match(r"\w+", str(error))  # the key that the refusal names
        if first_word and first_word.group() in types:
            path = (*path, first_word.group())
        raise TableError(str(error), path) from error


def _unknown_choice(key: str, value: str, choices: Mapping[str, tuple[object, ...]]) -> str:
    """Return the message that a key has no such choice, with the keys that have it, or one of which it is part."""
    fitting = [
        f"{other} = {choice!r}"
        for other, of in choices.items()
        for choice in of
        if other != key and value.lower() in (choice, *re.split("[-_]", str(choice)))
    ]
    meant = f"; or is {' or '.join(fitting)} meant?" if fitting else ""
    return unknown(value, [str(choice) for choice in choices[key]]) + meant


def convert_kind(table: object, kinds: Mapping[str, type[T]], path: KeyPath) -> T:
    """Convert a table to the type that its `kind` selects; raises TableError."""
    kind, keys = split_kind(table, kinds, path)
    return convert(keys, kinds[kind], path)


def split_kind(table: object, kinds: Collection[str], path: KeyPath) -> tuple[str, dict[str, Any]]:
    """Return a table's `kind`, one of `kinds`, and its other keys; raises TableError."""
    if not isinstance(table, dict):
        raise TableError(f"expected a table, got {table!r}", path)
    if "kind" not in table:
        raise TableError(f"'kind' is missing; one of {', '.join(kinds)}", (*path, "kind"))
    kind = str(table["kind"])
    if kind not in kinds:
        raise TableError(unknown(kind, list(kinds)), (*path, "kind"))
    return kind, {key: value for key, value in table.items() if key != "kind"}


def _field_types(target: Any) -> Mapping[str, Any]:
    hints = typing.get_type_hints(target)
    return {f.name: hints[f.name] for f in dataclasses.fields(target)}


field_types: Callable[[Any], Mapping[str, Any]] = cache(_field_types)  # for mypy a class is not hashable
"""Return the annotations of a dataclass's fields, by name, resolved."""


@cache
def kinds_of(annotation: Any) -> dict[str, Any]:
    """Return the dataclasses of a union by their `kind`; empty where there are not several to choose from."""
    members = typing.get_args(annotation) if _is_union(annotation) else ()
    tables = [member for member in members if dataclasses.is_dataclass(member)]
    return {vars(member)["kind"]: member for member in tables} if len(tables) > 1 else {}


@cache
def item_type(annotation: Any) -> Any:
    """Return the item type of a tuple[..., ...] of tables; None for anything else."""
    if typing.get_origin(annotation) is not tuple:
        return None
    item = typing.get_args(annotation)[0]
    return item if dataclasses.is_dataclass(item) or kinds_of(item) else None


@cache
def table_type(annotation: Any) -> Any:
    """Return the dataclass of `Table` or `Table | None`; None for other types."""
    members = typing.get_args(annotation) if _is_union(annotation) else (annotation,)
    return next((member for member in members if dataclasses.is_dataclass(member)), None)


Seed = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]
"""Seed of random numbers."""

TimeScale = Annotated[float, Meta(gt=0, le=1e6)]
"""Speed of motion relative to reality."""


def _is_union(annotation: Any) -> bool:
    return typing.get_origin(annotation) in (typing.Union, types.UnionType)


def _value(value: object, annotation: Any, path: KeyPath) -> object:
    if item := item_type(annotation):
        if not isinstance(value, list):
            raise TableError(f"expected a list of tables, got {value!r}", path)
        return tuple(_value(table, item, (*path, i)) for i, table in enumerate(value))
    if kinds := kinds_of(annotation):
        return convert_kind(value, kinds, path)
    table = table_type(annotation)
    return _plain(value, annotation, path) if table is None else convert(value, table, path)


def _plain(value: object, annotation: Any, path: KeyPath) -> object:
    try:
        return msgspec.convert(value, annotation)
    except msgspec.ValidationError as error:
        message = str(error)
        if at := _AT.search(message):
            message = message[: at.start()]
            path = (*path, *(int(index) for index in _INDEX.findall(at.group(1))))
        if annotation in _NUMBERS:
            unit = next((f" of {unit}" for unit in _UNITS if str(path[-1]).endswith(f"_{unit}")), "")
            raise TableError(f"must be {_NUMBERS[annotation]}{unit}, got {value!r}", path) from error
        raise TableError(f"{message}; here it is {value!r}", path) from error


RigFile = NewType("RigFile", str)
"""A path, absolute or from the rig file's folder; or a name that is no file, such as that of a shipped shape."""

NO_FILE = RigFile("")


def beside(value: T, folder: Path) -> T:
    """Return a dataclass, and those in it, with the whole path of each file that lies in `folder`."""
    if isinstance(value, tuple):
        tables = tuple(beside(table, folder) for table in value)
        return value if tables == value else tables  # type: ignore[return-value]
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    types = field_types(type(value))
    changed: dict[str, Any] = {}
    for name, annotation in types.items():
        old = getattr(value, name)
        if annotation == tuple[RigFile, ...]:
            files = tuple(str(folder / file) if os.path.isfile(folder / file) else file for file in old)
            new = old if files == old else files
        else:
            is_file = annotation is RigFile and os.path.isfile(folder / old)  # False for names that no file can have
            new = RigFile(str(folder / old)) if is_file else beside(old, folder)
        if new is not old:
            changed[name] = new
    return dataclasses.replace(value, **changed) if changed else value
