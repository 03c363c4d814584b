"""Keys of a rig as dotted text, such as "faults[0].rate", and values laid over the tables of a rig."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from emulator.tables.typed_table import Path, TableError

__all__ = ["laid_over", "path_of", "text_of", "with_value", "with_worker"]

_PART = re.compile(r"([A-Za-z_][A-Za-z0-9_-]*)((?:\[\d+\])*)")
_WORKER = "{worker}"


def path_of(key: str) -> Path:
    """Return the path that a dotted key writes; raises ValueError."""
    path: Path = ()
    for part in key.split("."):
        if not (found := _PART.fullmatch(part)):
            raise ValueError(f'key must be like "camera.sensor.threshold_on" or "faults[0].rate", got {key!r}')
        path = (*path, found[1], *(int(n) for n in re.findall(r"\d+", found[2])))
    return path


def text_of(path: Path) -> str:
    """Return a path as dotted text."""
    return "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in path).lstrip(".")


def with_value(table: Any, path: Path, value: Any, at: Path = ()) -> Any:
    """Return tables with one value in its place, tables that lack on the way made; the argument stays as it is."""
    if not path:
        return value
    head, rest = path[0], path[1:]
    if isinstance(head, int):
        if not isinstance(table, list) or head >= len(table):
            count = len(table) if isinstance(table, list) else 0
            raise TableError(f"{text_of((*at, head))} is not in the rig, which has {count} of them", (*at, head))
        return [*table[:head], with_value(table[head], rest, value, (*at, head)), *table[head + 1 :]]
    table = {} if table is None else table
    if not isinstance(table, dict):
        raise TableError(f"{text_of(at)} is no table", at)
    return {**table, head: with_value(table.get(head), rest, value, (*at, head))}


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
