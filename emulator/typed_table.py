"""Turns a table of a rig file into a frozen dataclass, or says exactly what is wrong with it.

msgspec converts and checks the types; what it does not do is done here: unknown keys with the nearest known one, and
the path of the key to blame when a dataclass refuses a value in its `__post_init__` (its message starts with the key).
"""

from __future__ import annotations

import dataclasses
import difflib
import re
import typing
from typing import Any, TypeVar

import msgspec

__all__ = ["Path", "TableError", "convert"]

Path = tuple[str | int, ...]
T = TypeVar("T")

_AT = re.compile(r" - at `\$(.*)`$")
_STEP = re.compile(r"\.([A-Za-z0-9_]+)|\[(\d+|\.\.\.)\]")


class TableError(Exception):
    """A value in a table is wrong; `path` leads to the key."""

    def __init__(self, message: str, path: Path) -> None:
        super().__init__(message)
        self.path = path


def convert(table: object, target: type[T], path: Path = ()) -> T:
    """Return `table` as a `target`; raises TableError."""
    if not isinstance(table, dict):
        raise TableError(f"expected a table, got {table!r}", path)
    _check_keys(table, target, path)
    try:
        return msgspec.convert(table, target)
    except msgspec.ValidationError as error:
        raise _located(error, target, path) from error


def unknown(key: str, known: list[str]) -> str:
    """Say that `key` is not known, and which one was probably meant."""
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    meant = f"; did you mean {near[0]!r}?" if near else f"; known are {', '.join(known)}"
    return f"{key!r} is not known here{meant}"


def _check_keys(table: dict[str, Any], target: type, path: Path) -> None:
    """Refuse unknown keys, in nested tables too."""
    types = typing.get_type_hints(target)
    for key, value in table.items():
        if key not in types:
            raise TableError(unknown(key, list(types)), (*path, key))
        if isinstance(value, dict) and dataclasses.is_dataclass(types[key]):
            _check_keys(value, types[key], (*path, key))


def _located(error: msgspec.ValidationError, target: type, path: Path) -> TableError:
    """Turn msgspec's message and its path (`$.a.b[0]`) into ours; a refusal in `__post_init__` names the key first."""
    message = str(error)
    if at := _AT.search(message):
        message = message[: at.start()]
        for name, index in _STEP.findall(at.group(1)):
            path += (name,) if name else (int(index),) if index.isdigit() else ()
            target = typing.get_type_hints(target).get(name, target) if dataclasses.is_dataclass(target) else target
    if missing := re.search(r"required field `(\w+)`", message):
        return TableError(f"{missing.group(1)!r} is missing", path)
    blamed = re.match(r"\w+", message)
    if blamed and dataclasses.is_dataclass(target) and blamed.group() in typing.get_type_hints(target):
        path = (*path, blamed.group())
    return TableError(message, path)
