"""The folder of a campaign: what the campaign was when it began, its rows, and who works on it now.

campaign.json        content and version; a campaign file that says something else is refused
rows/00000017.parquet   one row for each run that is done
rows.parquet         all of them, when all are done
runs/000017/         files of a run: the program's output and result, a recording
report.html          see `emulator.campaign.report`
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

from emulator.campaign.campaign import Campaign

__all__ = ["FolderError", "begin_folder", "check_folder", "rows_folder", "working_in"]

_MOST_TOLD = 8


class FolderError(Exception):
    """The folder belongs to another campaign, or another program works in it; the message says what to do."""


def rows_folder(folder: Path) -> Path:
    """Return where the single rows are."""
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
    """Return what a folder's campaign was when it began; raises FolderError where that is not this one."""
    before = _read(folder / "campaign.json")
    if before.get("id") != campaign.id:
        raise FolderError(_told_difference(campaign, folder, before, json.loads(_text(campaign))))
    return before


def _text(campaign: Campaign) -> str:
    """Return what campaign.json says."""
    told = {"id": campaign.id, "evstim": version("evstim"), **campaign.content}
    return json.dumps(told, indent=1, sort_keys=True, default=str) + "\n"


def _write_once(file: Path, text: str) -> None:
    """Write a file, unless another program of a job array was faster."""
    part = file.with_name(f".{file.name}.{os.getpid()}.part")
    part.write_text(text)
    try:
        os.link(part, file)
    except FileExistsError:
        pass
    finally:
        part.unlink()


def _read(file: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(file.read_text()))
    except FileNotFoundError as error:
        raise FolderError(f"{file.parent} is no folder of a campaign; give its --folder") from error
    except ValueError as error:
        raise FolderError(f"{file} is damaged; give another --folder") from error


def _told_difference(campaign: Campaign, folder: Path, before: dict[str, Any], now: dict[str, Any]) -> str:
    differences = [line for part in ("campaign", "rig") for line in _differences(before.get(part), now.get(part), part)]
    more = [f"and {len(differences) - _MOST_TOLD} more"] if len(differences) > _MOST_TOLD else []
    told = "; ".join([*differences[:_MOST_TOLD], *more])
    return (
        f"{folder} has the runs of another campaign: {told}. Undo the change in {campaign.source.file}, "
        "or give another --folder"
    )


def _differences(before: Any, now: Any, at: str) -> Iterator[str]:
    if isinstance(before, dict) and isinstance(now, dict):
        for key in sorted({*before, *now}):
            yield from _differences(before.get(key), now.get(key), f"{at}.{key}")
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        for i, (one, other) in enumerate(zip(before, now, strict=True)):
            yield from _differences(one, other, f"{at}[{i}]")
    elif before != now:
        yield f"{at} was {_short(before)}, is {_short(now)}"


def _short(value: Any) -> str:
    text = "not there" if value is None else json.dumps(value)
    return text if len(text) < 80 else f"{text[:80]} ..."


@contextmanager
def working_in(folder: Path, *, alone: bool) -> Iterator[None]:
    """Keep other programs from the folder's runs meanwhile; those of a job array (not `alone`) share it.

    Raises FolderError. The lock ends with the process, however that ends.
    """
    with (folder / ".lock").open("a") as file:
        try:
            fcntl.flock(file, (fcntl.LOCK_EX if alone else fcntl.LOCK_SH) | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FolderError(f"another evstim campaign works in {folder}: wait for it, or end it") from error
        if alone:
            for part in rows_folder(folder).glob(".*.part"):  # a program was killed while it wrote
                part.unlink()
        yield
