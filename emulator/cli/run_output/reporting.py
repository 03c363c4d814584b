"""`--report DIR`: what is observed of a run, and written when it has ended."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from emulator.cli.output import LACKING, WRONG_USE, Failure, console
from emulator.report.figures import ChartsLacking, check
from emulator.rig.loading import Rig
from emulator.run.outcome import RunResult, RunStatus
from emulator.run.report.observation import Observation
from emulator.run.report.page import Reported, write_report
from emulator.run.verdict import judge
from firmware_protocol.events import Events

__all__ = ["Reporting", "begin_report"]


class Reporting:
    """Takes what a run shows; writes nothing where no folder was asked for."""

    def __init__(self, rig: Rig, folder: Path | None) -> None:
        self._rig = rig
        self._folder = folder
        self._seen = Observation(rig.camera.size) if folder is not None else None

    def take(self, events: Events) -> None:
        """Count the events of a step."""
        if self._seen is not None:
            self._seen.take(events)

    def renew(self, status: RunStatus) -> None:
        """Take note of how the run stands."""
        if self._seen is not None:
            self._seen.renew(status)

    def write(self, result: RunResult, summary: Mapping[str, Any]) -> None:
        """Write the report and name it; where that fails the run's own result still stands."""
        if self._folder is None or self._seen is None:
            return
        judgements = judge(self._rig.verdict, result)
        reported = Reported(self._rig, result, self._seen, judgements, summary, version("evstim"))
        try:
            paths = write_report(reported, self._folder)
        except OSError as error:
            console.print(
                f"--report: {error.strerror or error} ({self._folder}): the report is not whole", markup=False
            )
        else:
            console.print(f"report: {paths[0]}", markup=False)


def begin_report(rig: Rig, folder: Path | None) -> Reporting:
    """Make the folder, which may exist already; raises Failure where that, or a chart, is not possible."""
    if folder is None:
        return Reporting(rig, None)
    try:
        check()
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / "report.html"
        probe.open("ab").close()
    except ChartsLacking as error:
        raise Failure(f"--report: {error}", LACKING) from error
    except OSError as error:
        raise Failure(f"--report: {folder}: {error.strerror or error}", WRONG_USE) from error
    return Reporting(rig, folder)
