"""The folder and the table of a campaign: a Parquet file for each run as it ends, and one for all of them at the end.

A file appears whole, under the name of its run, or not at all: a run is done when its file exists, and can be there
only once. DuckDB, pandas and polars read both forms. The folder contains:

campaign.json        content and version; a campaign file with another content is refused
rows/00000017.parquet   one row for each run that is done
rows.parquet         all of them, when all are done
runs/000017/         files of a run: the program's output and result, a recording
report.html          see `emulator.campaign.report`
"""

from __future__ import annotations

import fcntl
import importlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any

from emulator.campaign.campaign import Campaign, Row
from emulator.campaign.loading import OPTIONS
from emulator.tables.toml_text import dotted
from transports.needs import install_command

_SUFFIX = ".parquet"
_PLAIN = {"compression": "none", "use_dictionary": False, "write_statistics": False, "store_schema": False}


class TablesLacking(Exception):
    """pyarrow is not installed; the message contains the command that installs it."""


class RowUnreadable(Exception):
    """A row's file is damaged; the message names it."""


def check_tables() -> None:
    """Raise TablesLacking where pyarrow is missing, before the first run."""
    _parquet()


def _parquet() -> Any:
    try:
        importlib.import_module("pyarrow")
        return importlib.import_module("pyarrow.parquet")
    except ImportError as error:
        raise TablesLacking(f"campaigns need pyarrow:  {install_command('campaign')}") from error


def write_row(folder: Path, row: Row) -> None:
    """Write a row's file, whole or not at all; raises OSError."""
    write_table(folder / f"{row['index']:08d}{_SUFFIX}", [row])


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """Write all rows as one file, whole or not at all; raises OSError."""
    content = _file_of(rows)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def _file_of(rows: Sequence[Row]) -> Any:
    """Return rows as the bytes of a Parquet file."""
    pyarrow = importlib.import_module("pyarrow")
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {name: _column([row.get(name) for row in rows], pyarrow) for name in names}
    table = pyarrow.Table.from_arrays(list(columns.values()), list(columns))  # `pyarrow.table` would import pandas
    memory = pyarrow.BufferOutputStream()
    _parquet().write_table(table, memory, **(_PLAIN if len(rows) == 1 else {}))
    return memory.getvalue()


def _column(values: list[Any], pyarrow: Any) -> Any:
    """Return values as one type: mixed values become text, missing ones float."""
    kinds = {type(value) for value in values if value is not None}
    if kinds <= {float, int} and kinds != {int}:
        return pyarrow.array([None if v is None else float(v) for v in values], pyarrow.float64())
    if kinds in ({int}, {bool}):
        return pyarrow.array(values, pyarrow.int64() if kinds == {int} else pyarrow.bool_())
    return pyarrow.array([None if v is None else str(v) for v in values], pyarrow.string())


def done_rows(folder: Path) -> set[int]:
    """Return the indices of the runs whose rows are in a folder, which may not exist yet."""
    if not folder.is_dir():
        return set()
    names = [name for name in os.listdir(folder) if name.endswith(_SUFFIX) and not name.startswith(".")]
    return {int(name.removesuffix(_SUFFIX)) for name in names if name.removesuffix(_SUFFIX).isdigit()}


def read_rows(folder: Path, rows_by_index: Mapping[int, Row] = MappingProxyType({})) -> list[Row]:
    """Return the rows of a folder in order of index; those of `known` are not read again. Raises RowUnreadable."""
    return [rows_by_index.get(index) or read_row(folder, index) for index in sorted(done_rows(folder))]


def read_row(folder: Path, index: int) -> Row:
    """Return the row of one run; raises RowUnreadable."""
    parquet, path = _parquet(), folder / f"{index:08d}{_SUFFIX}"
    try:
        (row,) = parquet.ParquetFile(path).read().to_pylist()
    except Exception as error:  # pyarrow may raise any exception for a damaged file
        message = f"{path} is damaged ({type(error).__name__}): delete it, and its run is done again"
        raise RowUnreadable(message) from error
    return dict(row)


_MOST_LISTED = 8


class FolderError(Exception):
    """The folder belongs to another campaign, or another program works in it; the message contains the remedy."""


def rows_folder(folder: Path) -> Path:
    """Return the folder of the single rows."""
    return folder / "rows"


def begin_folder(campaign: Campaign, folder: Path) -> str:
    """Make the folder, or check that it is of this campaign; return a remark, or "". Raises FolderError and OSError."""
    rows_folder(folder).mkdir(parents=True, exist_ok=True)
    file = folder / "campaign.json"
    if not file.exists():
        _write_once(file, _text(campaign))
    before = check_folder(campaign, folder)
    if before.get("evstim") != (now := version("evstim")):
        return f"rows of evstim {before.get('evstim')} are in {folder}; this is {now}: runs may differ"
    return ""


def check_folder(campaign: Campaign, folder: Path) -> dict[str, Any]:
    """Return the campaign that a folder was begun with; raises FolderError where that is not this one."""
    before = _read(folder / "campaign.json")
    if before.get("id") != campaign.id:
        raise FolderError(_difference_message(campaign, folder, before, json.loads(_text(campaign))))
    return before


def _text(campaign: Campaign) -> str:
    """Return the text of campaign.json."""
    content = {"id": campaign.id, "evstim": version("evstim"), **campaign.content}
    return json.dumps(content, indent=1, sort_keys=True, default=str) + "\n"


def _write_once(file: Path, text: str) -> None:
    """Write a file, unless another program of a job array was faster."""
    part = file.with_name(f".{file.name}.{os.getpid()}.part")
    part.write_text(text)
    try:
        with suppress(FileExistsError):
            os.link(part, file)
    finally:
        part.unlink()


def _read(file: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(file.read_text()))
    except FileNotFoundError as error:
        raise FolderError(f"{file.parent} is no folder of a campaign; give its --folder") from error
    except ValueError as error:
        raise FolderError(f"{file} is damaged; give another folder") from error


def _difference_message(campaign: Campaign, folder: Path, before: dict[str, Any], now: dict[str, Any]) -> str:
    differences = [line for part in ("campaign", "rig") for line in _differences(before.get(part), now.get(part), part)]
    content, remedy = "runs of another campaign", f"Undo the change in {campaign.source.file}, or give another --folder"
    if campaign.source.author_file:
        content = "sequences of another data set"
        remedy = "Give the options, the rig and the file of --vary as they were, or another folder with --out"
        names = {f"campaign.{dotted(path)} ": f"{option}: " for path, option in OPTIONS.items()}
        differences = [next((names[key] for key in names if line.startswith(key)), "") + line for line in differences]
    remainder = [f"and {len(differences) - _MOST_LISTED} more"] if len(differences) > _MOST_LISTED else []
    listed = "; ".join([*differences[:_MOST_LISTED], *remainder])
    return f"{folder} has the {content}: {listed}. {remedy}"


def _differences(before: Any, now: Any, at: str) -> Iterator[str]:
    if isinstance(before, dict) and isinstance(now, dict):
        for key in sorted({*before, *now}):
            yield from _differences(before.get(key), now.get(key), f"{at}.{key}")
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        for i, (old, other) in enumerate(zip(before, now, strict=True)):
            yield from _differences(old, other, f"{at}[{i}]")
    elif before != now:
        yield f"{at} was {_short(before)}, is {_short(now)}"


def _short(value: Any) -> str:
    text = "not there" if value is None else json.dumps(value)
    return text if len(text) < 80 else f"{text[:80]} ..."


@contextmanager
def working_in(folder: Path, *, alone: bool) -> Iterator[None]:
    """Lock the folder, at longest while the process lives; a job array (not `alone`) shares it. Raises FolderError."""
    with (folder / ".lock").open("a") as file:
        try:
            fcntl.flock(file, (fcntl.LOCK_EX if alone else fcntl.LOCK_SH) | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FolderError(f"another evstim campaign works in {folder}: wait for it, or end it") from error
        if alone:
            for part in rows_folder(folder).glob(".*.part"):  # a program was killed while it wrote
                part.unlink()
        yield
