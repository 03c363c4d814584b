"""TOML text as tables, with line numbers in messages; text files of unknown origin.

The standard reader keeps no positions. `line_of` reads no values: only table headers and the keys at the start of
lines, which is all that a rig file has. A text file must be a regular file of a bounded size, in UTF-8; messages have a
bounded length.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

_MOST_SHOWN = 400


class TextFileError(Exception):
    """The text cannot be read; the message contains the reason, without the file's name."""


def read_text(path: Path, most_bytes: int) -> str:
    """Return the text of a file of at most `most_bytes`; raises TextFileError."""
    try:
        if path.exists() and not path.is_file():
            raise TextFileError("cannot be read: it is no regular file")
        if (size := path.stat().st_size) > most_bytes:
            raise TextFileError(f"is {size} bytes long: at most {most_bytes} are read")
        return path.read_bytes().decode("utf-8")
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise TextFileError(
            f"cannot be read: line {line}: byte 0x{error.object[error.start]:02x} is not UTF-8: save the file as "
            "UTF-8, or leave the letter out"
        ) from error
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        raise TextFileError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from error


def shortened(error: BaseException) -> str:
    """Return an error's message for people, or its type where it has none: a damaged file may bring pages of text."""
    text = str(error) or type(error).__name__
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]} ..."


_HEADER = re.compile(r"^\s*(\[\[?)\s*([A-Za-z0-9_.\-\" ]+?)\s*\]\]?\s*(#.*)?$")
_KEY = re.compile(r"^\s*([A-Za-z0-9_\-\"]+(?:\s*\.\s*[A-Za-z0-9_\-\"]+)*)\s*=")
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_GIVEN_TWICE = re.compile(r"Cannot overwrite|Cannot declare .* twice|Duplicate")

KeyPath = tuple[str | int, ...]


class TomlError(Exception):
    """A text is not valid TOML; the message is for its author.

    Attributes
    ----------
    line : of the mistake, from 1; None where the message has it.
    """

    def __init__(self, message: str, line: int | None = None) -> None:
        super().__init__(message)
        self.line = line

    def at(self, file: str) -> str:
        """Return the message with the file, and the line where there is one."""
        return f"{file}, line {self.line}: {self}" if self.line else f"{file}: {self}"


def read_toml(text: str) -> dict[str, Any]:
    """Return the tables of a text; raises TomlError."""
    try:
        return tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError, or a number with more digits than Python converts
        if _GIVEN_TWICE.search(str(error)):
            raise _given_twice(text, error) from error
        raise TomlError(f"not valid TOML: {shortened(error)}") from error
    except RecursionError as error:
        raise TomlError("not valid TOML: its arrays or tables are nested too deeply") from error


def _given_twice(text: str, error: ValueError) -> TomlError:
    """Return the error of a text that gives a key or a table twice."""
    first: dict[KeyPath, int] = {}
    for line, path, is_header in _paths(text):
        if path in first:
            name = dotted(path)[:200]
            repeated, remedy = (f"[{name}]", "put its keys under one header") if is_header else (name, "leave one out")
            return TomlError(f"{repeated} is given twice, first in line {first[path]}: {remedy}", line)
        first[path] = line
    return TomlError(f"not valid TOML: a key or a table is given twice, leave one out: {shortened(error)}")


def toml_of(tables: Mapping[str, Any]) -> str:
    """Return tables, as `read_toml` gives them, as TOML text: those of the top level by headers, others inline."""
    lines, blocks = list[str](), list[str]()
    for key, value in tables.items():
        is_list = isinstance(value, list) and bool(value) and all(isinstance(item, Mapping) for item in value)
        header = f"[[{_key(key)}]]" if is_list else f"[{_key(key)}]"
        for table in value if is_list else [value] if isinstance(value, Mapping) else ():
            blocks += ["", header, *(f"{_key(name)} = {toml_value(item)}" for name, item in table.items())]
        if not is_list and not isinstance(value, Mapping):
            lines.append(f"{_key(key)} = {toml_value(value)}")
    return "\n".join([*lines, *blocks, ""])


def toml_value(value: Any) -> str:
    """Return a value on one line of TOML."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(key)} = {toml_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")  # JSON leaves this one as it is
    return str(value).lower()


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else toml_value(key)


def dotted(path: KeyPath) -> str:
    """Return a path in the usual notation: links[0].port."""
    return "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in path).lstrip(".")


def line_of(text: str, path: KeyPath) -> int | None:
    """Return the line (from 1) of the key or table at `path`, or of its nearest parent that has one."""
    lines: dict[KeyPath, int] = {}
    for line, written, _ in _paths(text):
        lines.setdefault(written, line)
    while path:
        if path in lines:
            return lines[path]
        path = path[:-1]
    return None


def _paths(text: str) -> Iterator[tuple[int, KeyPath, bool]]:
    """Yield the line of every path that is written in the text, the path, and whether it is that of a header."""
    table: KeyPath = ()
    counts: dict[KeyPath, int] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            table = _table(header.group(2), is_array=header.group(1) == "[[", counts=counts)
            yield number, table, True
        elif key := _KEY.match(line):
            yield number, table + _parts(key.group(1)), False


def _table(dotted: str, *, is_array: bool, counts: dict[KeyPath, int]) -> KeyPath:
    """Return the path of a header; `[[name]]` numbers its tables, and a sub-table belongs to the last of them."""
    path: KeyPath = ()
    parts = _parts(dotted)
    for i, part in enumerate(parts):
        path = (*path, part)
        if is_array and i == len(parts) - 1:
            counts[path] = counts.get(path, -1) + 1
        if path in counts:
            path = (*path, counts[path])
    return path


def _parts(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip().strip('"') for part in dotted.split("."))
