"""One run of a campaign: its rig built and run, the program under test beside it or after it, and its row.

The row is a pure function of campaign and index, but for the columns "machine.*" and for what real time changes.
"""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import platform
import shutil
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from emulator.campaign.campaign import Campaign
from emulator.campaign.columns import Row, judged, parameter_columns, result_columns
from emulator.campaign.loading import CampaignError
from emulator.campaign.placeholders import POSE_PORT, addresses_as_placeholders
from emulator.campaign.program import RunningProgram, end_leftover, result_of
from emulator.light import MachineLacks, SceneError
from emulator.rig.loading import Rig, RigError
from emulator.run.assembly import build_session, link_setups, schedule
from emulator.run.free_ports import on_a_free_pose_port, on_free_ports, pose_port
from emulator.run.link_process import LinkFailed
from emulator.run.outcome import RunResult, RunStatus
from emulator.run.scene_assembly import build_scene
from emulator.run.session import Session
from emulator.tables.registry import PluginError
from firmware_protocol.events import Events
from transports.link.pacing import MonotonicClock

__all__ = ["CampaignStopped", "Place", "run_folder", "run_row"]

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM)
_NO_SPACE = "No space left on device"


class CampaignStopped(Exception):
    """What is wrong is no matter of this run: the machine lacks something, or the disk is full."""


@dataclass(frozen=True)
class Place:
    """Where a run runs.

    Attributes
    ----------
    folder : of the campaign.
    worker : number of the worker, from 0.
    threads : of the pixel step, where the rig does not say.
    record : file for what the links deliver; None: as the campaign says.
    """

    folder: Path
    worker: int = 0
    threads: int = 1
    record: Path | None = None


def run_folder(folder: Path, index: int) -> Path:
    """Return the folder of a run's own files in the folder of the campaign."""
    return folder / "runs" / f"{index:06d}"


def run_row(campaign: Campaign, index: int, place: Place, on_session: Callable[[Session], None]) -> Row:
    """Run once and return the row; raises CampaignStopped. `on_session` is given what can be stopped."""
    begun_s, begun_cpu_s = time.monotonic(), time.process_time()
    begun = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    row: Row = {"index": index, "campaign": campaign.id, "outcome": "ok", "error": "", "seed": campaign.seed(index)}
    row |= parameter_columns(campaign.values(index))
    try:
        row |= _Run(campaign, index, place, on_session).row()
    except MachineLacks as error:
        raise CampaignStopped(str(error)) from error
    except OSError as error:
        if error.errno in _FULL:
            raise CampaignStopped(f"{error.filename or place.folder}: {error.strerror}") from error
        row |= {"outcome": "failed", "error": f"{error.strerror or error}: {error.filename or ''}"}
    except (SceneError, RigError, CampaignError, LinkFailed, PluginError) as error:
        row |= {"outcome": "failed", "error": str(error)}
    except Exception as error:  # noqa: BLE001 - one run that meets a mistake of ours must not end the campaign
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

    def row(self) -> Row:
        """Run, and return what came of it."""
        if self._settings.program is not None or self._settings.record:
            self._make_folder()
        rig = self._rig()
        with ExitStack() as stack:
            result = self._run(rig, stack)
            _check_space(result)
            row = result_columns(rig, result, self._digest.hexdigest())
            return row | self._program_columns(stack)

    def _make_folder(self) -> None:
        """Make the run's folder anew: nothing that an earlier, killed try left in it may be read."""
        end_leftover(self._folder, self._mark)
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir(parents=True)
        if self._settings.record and self._record is None:
            self._record = self._folder / f"delivered{self._settings.record}"
        told = {"index": self._index, "seed": self._campaign.seed(self._index), "values": self._values}
        (self._folder / "run.json").write_text(json.dumps(told, indent=1, default=str) + "\n")

    @property
    def _mark(self) -> str:
        return f"{self._campaign.id}/{self._index}"

    @property
    def _values(self) -> dict[str, Any]:
        return self._campaign.values(self._index)

    def _rig(self) -> Rig:
        rig = self._campaign.rig(self._index, self._place.worker)
        threads = rig.run.threads or self._place.threads  # the events are the same for any number
        rig = on_free_ports(dataclasses.replace(rig, run=dataclasses.replace(rig.run, threads=threads)), self._folder)
        return on_a_free_pose_port(rig)

    def _run(self, rig: Rig, stack: ExitStack) -> RunResult:
        with build_scene(rig) as scene:
            session = build_session(rig, scene, link_setups(rig, self._record), MonotonicClock())
            self._on_session(session)

            def renew(status: RunStatus) -> None:
                self._follow(session, status, stack, rig)

            return session.run(schedule(rig), renew, self._take)

    def _take(self, events: Events) -> None:
        if len(events):
            self._digest.update(np.ascontiguousarray(events).data)

    def _follow(self, session: Session, status: RunStatus, stack: ExitStack, rig: Rig) -> None:
        """Start the program when the links are open, and end the run with it where that is asked for."""
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
        told = {"program.exit": code, "program.trouble": trouble, "machine.program_s": seconds}
        return {**columns, **told}


def _check_space(result: RunResult) -> None:
    """Raise CampaignStopped where a file of the run has no room: the run itself is not to blame."""
    for link in result.links.values():
        for trouble in link.file_troubles:
            if _NO_SPACE in trouble:
                raise CampaignStopped(trouble)
