"""Work around a command: errors of the packages as its failures, checks of its files, compilation before it begins.

The packages that it imports load numba. What the command line itself needs is in `output`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from emulator.cli.output import LACKING, WRONG_USE, Failure, failing, status
from emulator.light import MachineLacks, SceneError
from emulator.rig.loading import RigError
from emulator.run.kernels import Part, Preparation, prepare, uncompiled
from emulator.run.link_process import LinkFailed
from transports.registry import PluginError


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


def prepared(parts: Sequence[Part]) -> None:
    """Compile those of the parts that this machine has not compiled yet."""
    missing = uncompiled(parts)
    if not missing:
        return
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
