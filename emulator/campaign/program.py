"""The program under test: a process group of its own, its output in the run's folder, its JSON result as columns."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from emulator.campaign.placeholders import filled
from emulator.campaign.tables import Program
from emulator.tables.text_file import TextFileError, read_text

__all__ = ["RunningProgram", "end_leftover", "result_of"]

_MOST_BYTES = 1 << 20
_MOST_COLUMNS = 200
_TERMINATION_S = 3.0
_MARK = "EVSTIM_RUN"
_PID_FILE = "program.pid"


class RunningProgram:
    """One start of the program; use it in a `with` block, at whose end nothing of it runs any more.

    Parameters
    ----------
    mark : names the run in the program's environment, so that one that outlives its run is found.
    values : for the placeholders.

    Raises
    ------
    OSError
        It cannot be started.
    """

    def __init__(self, program: Program, folder: Path, cwd: Path, mark: str, values: Mapping[str, Any]) -> None:
        self._begun_s = time.monotonic()
        self._folder = folder
        argv = filled(program.argv, {"python": sys.executable, **values})
        with (folder / "output.txt").open("wb") as output:
            self._process = subprocess.Popen(
                argv,
                cwd=cwd,
                env={**os.environ, _MARK: mark},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C is for the campaign, and all that it starts can be ended at once
            )
        (folder / _PID_FILE).write_text(str(self._process.pid))

    @property
    def ended(self) -> bool:
        """Whether it has ended by itself."""
        return self._process.poll() is not None

    def wait(self, grace_s: float) -> tuple[int | None, float]:
        """Wait for its end; return exit code and seconds since its start. The code is None after `grace_s`."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(grace_s)
        return self._process.poll(), time.monotonic() - self._begun_s

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if not self.ended:
            _signal(self._process.pid, signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(_TERMINATION_S)
        _signal(self._process.pid, signal.SIGKILL)  # its children as well
        self._process.wait()
        (self._folder / _PID_FILE).unlink(missing_ok=True)


def _signal(group: int, number: int) -> None:
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(group, number)


def end_leftover(folder: Path, mark: str) -> None:
    """End a program that a killed worker has left running in a run's folder; its environment proves that it is one."""
    with suppress(OSError, ValueError):
        pid = int((folder / _PID_FILE).read_text())
        if f"{_MARK}={mark}".encode() in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0"):
            _signal(pid, signal.SIGKILL)


def result_of(file: Path) -> tuple[dict[str, Any], str]:
    """Return what the program wrote as its result, by column, and what is wrong with it: "" for nothing.

    A program that wrote no file gives no columns. Whole numbers become floats: a column has one type in all rows.
    """
    if not file.exists():
        return {}, ""
    try:
        told = json.loads(read_text(file, _MOST_BYTES))
    except (TextFileError, ValueError, RecursionError) as error:
        return {}, f"result: no JSON: {str(error)[:200]}"
    if not isinstance(told, dict) or len(told) > _MOST_COLUMNS:
        return {}, f"result: expected one JSON object of at most {_MOST_COLUMNS} values"
    wrong = [key for key, value in told.items() if not isinstance(value, str | int | float | bool | None)]
    columns = {f"result.{key}": _plain(value) for key, value in told.items() if key not in wrong}
    return columns, f"result: {', '.join(wrong[:5])}: neither number, text nor bool" if wrong else ""


def _plain(value: Any) -> Any:
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value
