"""Recordings that verbs read and write: their options, checks before the work, and errors as Failure.

Apart from `checks`, because a run reads none, and need not load the readers.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from emulator.cli.checks import check_output
from emulator.cli.output import BAD_VERDICT, LACKING, WRONG_USE, Failure, failing, status
from emulator.rig.loading import Rig
from firmware_protocol.recordings.event_table import TableForm
from transports.recording.files import OpenRecording
from transports.recording.format import Format, format_to_write, reason
from transports.recording.part import DamagedRecording, LibraryMissing, RecordingError

Table = Annotated[TableForm, Parameter(name="*")]
"""The options `--columns` and `--time-unit` of a verb that reads a recording."""
AS_IT_IS = TableForm()


def check_recording(option: str, path: Path, name: str = "") -> Format:
    """Return the format that `path` will be written in; raises Failure where it cannot be."""
    try:
        form = format_to_write(path, name)
        form.imported(form.writer)
    except RecordingError as error:
        lacks = "pip install" in str(error)
        raise Failure(f"{option}: {error}", LACKING if lacks else WRONG_USE) from error
    if form.is_folder:
        if path.exists():
            raise Failure(f"{option}: {path} exists; a {form.title} is a folder of its own", WRONG_USE)
        if not path.parent.is_dir():
            raise Failure(f"{option}: the folder {path.parent} does not exist", WRONG_USE)
    else:
        check_output(option, path)
    return form


def check_record(rig: Rig, record: Path) -> None:
    """Raise Failure where `--record` cannot write what the links of a rig deliver."""
    if not rig.links:
        raise Failure("--record: this rig has no link, so no event is delivered", WRONG_USE)
    check_recording("--record", record)


def parsed_size(text: str | None) -> tuple[int, int] | None:
    """Return (width, height) of text such as "346x260"; raises Failure."""
    if text is None:
        return None
    size = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if size is None or not int(size[1]) or not int(size[2]):
        raise Failure(f"--size must be WIDTHxHEIGHT such as 346x260, got {text!r}", WRONG_USE)
    return int(size[1]), int(size[2])


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn errors of a recording that is read into Failure."""
    ends = partial(failing, at=str(path))
    with ends(WRONG_USE, RecordingError, OSError), ends(LACKING, LibraryMissing), ends(BAD_VERDICT, DamagedRecording):
        yield


@contextmanager
def recording_of(
    path: Path, size: str | None, table: TableForm, topic: str | None = None, *, strict: bool = True
) -> Iterator[OpenRecording]:
    """Open a recording and print the assumptions about it; its errors become Failure, as in `reading`."""
    sensor = parsed_size(size)
    with reading(path), OpenRecording(path, sensor, strict=strict, table=table, topic=topic) as recording:
        for remark in recording.facts.remarks:
            status.print(f"{path}: {remark}", markup=False)
        yield recording


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn errors while a recording is written into Failure; libraries may raise any exception."""
    try:
        yield
    except (Failure, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise Failure(f"{path}: {reason(error)}", LACKING if isinstance(error, OSError) else WRONG_USE) from error
