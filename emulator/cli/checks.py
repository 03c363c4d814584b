"""Work around a command: errors of the packages as its failures, checks of its files, compilation before it begins.

The packages that it imports load numba. What the command line itself needs is in `output`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from emulator.cli.output import BAD_VERDICT, LACKING, WRONG_USE, Failure, failing, status
from emulator.light import MachineLacks, SceneError
from emulator.rig.loading import Rig, RigError
from emulator.run.kernels import Part, Preparation, prepare, uncompiled
from emulator.run.link_process import LinkFailed
from firmware_protocol.recordings.event_table import TableForm
from transports.recording.files import OpenRecording
from transports.recording.format import Format, format_to_write, reason
from transports.recording.part import DamagedRecording, LibraryMissing, RecordingError
from transports.registry import PluginError

Table = Annotated[TableForm, Parameter(name="*")]
"""The options `--columns` and `--time-unit` of a verb that reads a recording."""
AS_IT_IS = TableForm()


@contextmanager
def failures() -> Iterator[None]:
    """Turn the errors of the packages into Failure with its exit code."""
    with failing(WRONG_USE, RigError, SceneError), failing(LACKING, MachineLacks, LinkFailed, PluginError):
        yield


def check_output(option: str, path: Path | None, suffix: str = "") -> None:
    """Raise Failure where a file cannot be written, or does not end in `suffix`; a path of None is no file."""
    if path is None:
        return
    if suffix and path.suffix != suffix:
        raise Failure(f"{option}: {path} must end in {suffix}, the one format that is written", WRONG_USE)
    if not path.parent.is_dir():
        raise Failure(f"{option}: the folder {path.parent} does not exist", WRONG_USE)
    with failing(WRONG_USE, OSError, at=f"{option}: {path}"):
        if path.is_dir():
            raise Failure(f"{option}: {path} is a folder; name a file", WRONG_USE)
        _open_once(path)


def _open_once(path: Path) -> None:
    """Open a file for writing without changing its content; raises OSError.

    A missing file does not appear under its name, not even for an instant: another program may wait for it.
    """
    is_new = not path.exists()
    tried = path.with_name(f".{path.name}.{os.getpid()}") if is_new else path
    os.close(os.open(tried, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NONBLOCK, 0o666))  # a pipe must not wait
    if is_new:
        tried.unlink()


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


def check_record(rig: Rig, record: Path | None) -> None:
    """Raise Failure where `--record` cannot write what the links of a rig deliver; None is no file."""
    if record is None:
        return
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


def prepared(parts: Sequence[Part]) -> int:
    """Compile those of the parts that this machine has not compiled yet; return how many these were."""
    missing = uncompiled(parts)
    if not missing:
        return 0
    names = ", ".join(part.name for part in missing)
    status.print(f"compiling, once on this machine: {names}", markup=False)
    columns = TextColumn("compiling"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn(), TextColumn("left")
    with Progress(*columns, console=status, transient=True, disable=not status.is_terminal) as bar:
        task = bar.add_task("compiling", total=1.0)
        printed: set[str] = set()

        def show(state: Preparation) -> None:
            bar.update(task, completed=state.share)
            for name in [] if status.is_terminal else [n for n in state.ended if n not in printed]:
                printed.add(name)
                left_s = bar.tasks[0].time_remaining  # None: not known yet
                left = f", about {left_s:.0f} s left" if left_s else ""
                status.print(f"compiled: {name} ({len(state.ended)} of {len(missing)}){left}", markup=False)

        failed = prepare(missing, show)
    if failed:
        status.print(f"not compiled ahead: {', '.join(failed)}; that happens during the run", markup=False)
    return len(missing)
