"""One run of a campaign: its rig, the program under test beside it or after it, and its row.

The row is a pure function of campaign and index, but for the columns "machine.*" and for effects of real time. The
program under test is a process group of its own, with its output in the run's folder, and its JSON result as columns.
"""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

import numpy as np

from emulator.campaign.campaign import (
    POSE_PORT,
    Campaign,
    Row,
    addresses_as_placeholders,
    filled,
    judged,
    parameter_columns,
    result_columns,
)
from emulator.campaign.dataset import check_layers, sequence_path, written_sequence
from emulator.campaign.loading import CampaignError, Program
from emulator.light import MachineLacks, SceneError
from emulator.rig.loading import Rig, RigError
from emulator.run.assembly import build_scene, build_session, link_setups, schedule
from emulator.run.link_process import LinkFailed
from emulator.run.machine import on_a_free_pose_port, on_free_ports, pose_port
from emulator.run.outcome import RunResult, RunStatus
from emulator.run.session import Session
from emulator.run.truth.source import RunTruth, TruthRefused
from emulator.tables.toml_text import TextFileError, read_text
from firmware_protocol.events import Events
from transports.link.pacing import MonotonicClock
from transports.registry import PluginError

_MOST_BYTES = 1 << 20
_MOST_COLUMNS = 200
_TERMINATION_S = 3.0
_MARK = "EVSTIM_RUN"
_PID_FILE = "program.pid"


class RunningProgram:
    """One start of the program; use it in a `with` block, at whose end the whole process group has ended.

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
                start_new_session=True,  # Ctrl-C is for the campaign, and the whole group can be ended at once
            )
        (folder / _PID_FILE).write_text(str(self._process.pid))

    @property
    def ended(self) -> bool:
        """True when it has ended by itself."""
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
    """End a program that a killed worker has left running in a run's folder; its environment identifies it."""
    with suppress(OSError, ValueError):
        pid = int((folder / _PID_FILE).read_text())
        if f"{_MARK}={mark}".encode() in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0"):
            _signal(pid, signal.SIGKILL)


def result_of(file: Path) -> tuple[dict[str, Any], str]:
    """Return the program's result by column, and the error in it: "" for none.

    A program that wrote no file gives no columns. Whole numbers become floats: a column has one type in all rows.
    """
    if not file.exists():
        return {}, ""
    try:
        result = json.loads(read_text(file, _MOST_BYTES))
    except (TextFileError, ValueError, RecursionError) as error:
        return {}, f"result: no JSON: {str(error)[:200]}"
    if not isinstance(result, dict) or len(result) > _MOST_COLUMNS:
        return {}, f"result: expected one JSON object of at most {_MOST_COLUMNS} values"
    wrong = [key for key, value in result.items() if not isinstance(value, str | int | float | bool | None)]
    right = {key: value for key, value in result.items() if key not in wrong}
    columns = {f"result.{key}": float(value) if type(value) is int else value for key, value in right.items()}
    return columns, f"result: {', '.join(wrong[:5])}: neither number, text nor bool" if wrong else ""


_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO)
_NO_SPACE = "No space left on device"


class CampaignStopped(Exception):
    """The campaign cannot go on: the machine lacks something, or the disk is full."""


@dataclass(frozen=True)
class Place:
    """Folder and worker of a run.

    Attributes
    ----------
    folder : of the campaign.
    worker : number of the worker, from 0.
    threads : of the pixel step, where the rig does not give their number.
    record : file for the delivered events; None: as in the campaign file.
    """

    folder: Path
    worker: int = 0
    threads: int = 1
    record: Path | None = None


def run_folder(folder: Path, index: int) -> Path:
    """Return the folder of a run's own files in the folder of the campaign."""
    return folder / "runs" / f"{index:06d}"


def run_row(campaign: Campaign, index: int, place: Place, on_session: Callable[[Session], None]) -> Row:
    """Run once and return the row; raises CampaignStopped. `on_session` receives the session, which can be stopped."""
    begun_s, begun_cpu_s = time.monotonic(), time.process_time()
    begun = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    row: Row = {"index": index, "campaign": campaign.id, "outcome": "ok", "error": "", "seed": campaign.seed(index)}
    row |= parameter_columns(campaign.values(index))
    try:
        row |= _Run(campaign, index, place, on_session).row()
    except (MachineLacks, TruthRefused) as error:
        raise CampaignStopped(str(error)) from error
    except OSError as error:
        if error.errno in _FULL:
            raise CampaignStopped(f"{error.filename or place.folder}: {error.strerror}") from error
        row |= {"outcome": "failed", "error": f"{error.strerror or error}: {error.filename or ''}"}
    except (SceneError, RigError, CampaignError, LinkFailed, PluginError) as error:
        row |= {"outcome": "failed", "error": str(error)}
    except Exception as error:  # noqa: BLE001 - a run that fails by an internal error must not end the campaign
        row |= {"outcome": "failed", "error": f"{type(error).__name__}: {error}"}
    row |= {"machine.host": platform.node(), "machine.begun": begun, "machine.version": _version()}
    row |= {"machine.wall_s": time.monotonic() - begun_s, "machine.cpu_s": time.process_time() - begun_cpu_s}
    return judged(campaign.settings, row)


@cache
def _version() -> str:
    return version("evstim")  # reads a file each time


class _Run:
    """The parts of one run."""

    def __init__(self, campaign: Campaign, index: int, place: Place, on_session: Callable[[Session], None]) -> None:
        self._campaign = campaign
        self._settings = campaign.settings
        self._index = index
        self._place = place
        self._on_session = on_session
        self._digest = hashlib.blake2b(digest_size=8)
        self._folder = run_folder(place.folder, index)
        self._record = place.record
        self._cwd = Path(campaign.source.file).parent
        self._started: RunningProgram | None = None
        self._values = campaign.values(index)
        self._mark = f"{campaign.id}/{index}"

    def row(self) -> Row:
        """Run, and return the row."""
        if self._settings.program is not None or self._settings.record:
            self._make_folder()
        rig = self._rig()
        with ExitStack() as stack:
            result, columns = self._run(rig, stack)
            for trouble in (trouble for link in result.links.values() for trouble in link.file_troubles):
                if _NO_SPACE in trouble:  # this is no fault of the run
                    raise CampaignStopped(trouble)
            row = result_columns(rig, result, self._digest.hexdigest())
            return row | columns | self._program_columns(stack)

    def _make_folder(self) -> None:
        """Make the run's folder, without the files of an earlier, killed try."""
        end_leftover(self._folder, self._mark)
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir(parents=True)
        if self._settings.record and self._record is None:
            self._record = self._folder / f"delivered{self._settings.record}"
        description = {"index": self._index, "seed": self._campaign.seed(self._index), "values": self._values}
        (self._folder / "run.json").write_text(json.dumps(description, indent=1, default=str) + "\n")

    def _rig(self) -> Rig:
        rig = self._campaign.rig(self._index, self._place.worker)
        threads = rig.run.threads or self._place.threads  # the events are the same for any number
        rig = on_free_ports(dataclasses.replace(rig, run=dataclasses.replace(rig.run, threads=threads)), self._folder)
        return on_a_free_pose_port(rig)

    def _run(self, rig: Rig, stack: ExitStack) -> tuple[RunResult, Row]:
        """Return the result, and the columns of the truth."""
        with build_scene(rig) as scene, self._truth(rig) as truth:
            session = build_session(rig, scene, link_setups(rig, self._record), MonotonicClock(), truth)
            if truth is not None and self._settings.truth is not None:
                check_layers(self._settings.truth, truth)
            self._on_session(session)

            def renew(status: RunStatus) -> None:
                self._follow(session, status, stack, rig)

            result = session.run(schedule(rig), renew, self._take)
            if truth is not None and result.sim_seconds < rig.run.seconds:
                raise SceneError(result.scene_trouble or "the run was stopped")
        return result, {} if truth is None else {"truth.digest": truth.digest}

    def _truth(self, rig: Rig) -> AbstractContextManager[RunTruth | None]:
        truth = self._settings.truth
        if truth is None:
            return nullcontext()
        return written_sequence(rig, truth, sequence_path(self._place.folder, self._index, truth))

    def _take(self, events: Events) -> None:
        if len(events):
            self._digest.update(np.ascontiguousarray(events).data)

    def _follow(self, session: Session, status: RunStatus, stack: ExitStack, rig: Rig) -> None:
        """Start the program when the links are open, and end the run with it where `ends_run` is set."""
        program = self._settings.program
        if program is None or program.start == "after":
            return
        if self._started is None:
            addresses = {name: link.address for name, link in status.links.items()}
            self._start(stack, addresses, pose_port(rig))
        elif program.ends_run and self._started.ended:
            session.stop()

    def _start(self, stack: ExitStack, addresses: dict[str, str | None], poses: int | None = None) -> RunningProgram:
        program = self._settings.program
        assert program is not None, "a program is started where there is one"
        values = {
            "index": self._index,
            "seed": self._campaign.seed(self._index),
            "folder": self._folder,
            "result": self._folder / "result.json",
            "record": self._record,
            "worker": self._place.worker,
            **self._values,
            **addresses_as_placeholders(addresses),
            POSE_PORT: poses,
        }
        self._started = RunningProgram(program, self._folder, self._cwd, self._mark, values)
        return stack.enter_context(self._started)

    def _program_columns(self, stack: ExitStack) -> Row:
        program = self._settings.program
        if program is None:
            return {}
        running = self._started or self._start(stack, {})
        code, seconds = running.wait(program.grace_s)
        columns, trouble = result_of(self._folder / "result.json")
        if code is None:
            trouble = f"it did not end within {program.grace_s:g} s and was stopped"
        ending = {"program.exit": code, "program.trouble": trouble, "machine.program_s": seconds}
        return {**columns, **ending}
