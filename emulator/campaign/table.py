"""The table of a campaign: a Parquet file for each run as it ends, and one for all of them at the end.

A file appears whole, under the name of its run, or not at all: a run is done when its file is there, and can be there
only once. DuckDB, pandas and polars read both forms.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

from emulator.campaign.columns import Row
from transports.needs import install_command

__all__ = [
    "RowUnreadable",
    "TablesLacking",
    "check_tables",
    "done_rows",
    "read_row",
    "read_rows",
    "write_row",
    "write_table",
]

_SUFFIX = ".parquet"
_PLAIN = {"compression": "none", "use_dictionary": False, "write_statistics": False, "store_schema": False}


class TablesLacking(Exception):
    """pyarrow is not installed; the message tells how to get it."""


class RowUnreadable(Exception):
    """A row's file is damaged; the message names it."""


def check_tables() -> None:
    """Raise TablesLacking where pyarrow is missing: before hours of work, not after."""
    _parquet()


def _parquet() -> Any:
    try:
        importlib.import_module("pyarrow")
        return importlib.import_module("pyarrow.parquet")
    except ImportError as error:
        raise TablesLacking(f"campaigns need pyarrow:  {install_command('campaign')}") from error


def write_row(folder: Path, row: Row) -> None:
    """Write a row's file, whole or not at all; raises OSError."""
    _write(folder / f"{row['index']:08d}{_SUFFIX}", [row])


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """Write all rows as one file, whole or not at all; raises OSError."""
    _write(path, rows)


def _write(path: Path, rows: Sequence[Row]) -> None:
    whole = _file_of(rows)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.write(whole)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except BaseException:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise


def _file_of(rows: Sequence[Row]) -> Any:
    """Return rows as the bytes of a Parquet file."""
    pyarrow = importlib.import_module("pyarrow")
    columns = _columns(rows, pyarrow)
    table = pyarrow.Table.from_arrays(list(columns.values()), list(columns))  # `pyarrow.table` would import pandas
    memory = pyarrow.BufferOutputStream()
    _parquet().write_table(table, memory, **(_PLAIN if len(rows) == 1 else {}))
    return memory.getvalue()


def _columns(rows: Sequence[Row], pyarrow: Any) -> dict[str, Any]:
    names = list(dict.fromkeys(name for row in rows for name in row))
    return {name: _column([row.get(name) for row in rows], pyarrow) for name in names}


def _column(values: list[Any], pyarrow: Any) -> Any:
    """Return values as one type: what is mixed becomes text, what is all missing a float."""
    kinds = {type(value) for value in values if value is not None}
    if kinds <= {float, int} and kinds != {int}:
        return pyarrow.array([None if v is None else float(v) for v in values], pyarrow.float64())
    if kinds == {int}:
        return pyarrow.array(values, pyarrow.int64())
    if kinds == {bool}:
        return pyarrow.array(values, pyarrow.bool_())
    return pyarrow.array([None if v is None else str(v) for v in values], pyarrow.string())


def done_rows(folder: Path) -> set[int]:
    """Return the indices of the runs whose rows are in a folder, which may not exist yet."""
    if not folder.is_dir():
        return set()
    names = [name for name in os.listdir(folder) if name.endswith(_SUFFIX) and not name.startswith(".")]
    return {int(name.removesuffix(_SUFFIX)) for name in names if name.removesuffix(_SUFFIX).isdigit()}


def read_rows(folder: Path, known: Mapping[int, Row] = MappingProxyType({})) -> list[Row]:
    """Return the rows of a folder in the order of their indices; those of `known` are not read again.

    Raises RowUnreadable.
    """
    return [known.get(index) or read_row(folder, index) for index in sorted(done_rows(folder))]


def read_row(folder: Path, index: int) -> Row:
    """Return the row of one run; raises RowUnreadable."""
    parquet, path = _parquet(), folder / f"{index:08d}{_SUFFIX}"
    try:
        (row,) = parquet.ParquetFile(path).read().to_pylist()
    except Exception as error:  # pyarrow answers a damaged file with whatever its reader ran into
        told = f"{path} is damaged ({type(error).__name__}): delete it, and its run is done again"
        raise RowUnreadable(told) from error
    return dict(row)
