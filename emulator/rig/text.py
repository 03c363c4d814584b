"""Finds the line of a key in TOML text, so that a message can point at it.

The standard reader keeps no positions. This one reads no values: only table headers and the keys at the start of lines,
which is all that a rig file has.
"""

from __future__ import annotations

import re

__all__ = ["line_of"]

_HEADER = re.compile(r"^\s*(\[\[?)\s*([A-Za-z0-9_.\-\" ]+?)\s*\]\]?\s*(#.*)?$")
_KEY = re.compile(r"^\s*([A-Za-z0-9_\-\"]+(?:\s*\.\s*[A-Za-z0-9_\-\"]+)*)\s*=")

Path = tuple[str | int, ...]


def line_of(text: str, path: Path) -> int | None:
    """Return the line (from 1) of the key or table at `path`, or of its nearest parent that has one."""
    lines = _lines(text)
    while path:
        if path in lines:
            return lines[path]
        path = path[:-1]
    return None


def _lines(text: str) -> dict[Path, int]:
    """Map every path written in the text to the line where it first stands."""
    table: Path = ()
    counts: dict[Path, int] = {}
    found: dict[Path, int] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            table = _table(header.group(2), is_array=header.group(1) == "[[", counts=counts)
            found.setdefault(table, number)
        elif key := _KEY.match(line):
            found.setdefault(table + _parts(key.group(1)), number)
    return found


def _table(dotted: str, *, is_array: bool, counts: dict[Path, int]) -> Path:
    """Return the path of a header; `[[name]]` numbers its tables, and a sub-table belongs to the last of them."""
    path: Path = ()
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
