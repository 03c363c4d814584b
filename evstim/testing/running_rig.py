"""A rig that runs beside a test, on free ports; its last events are held for the report of a failure.

    RunningRig   starts a run, waits until its links are open, stops it, and lists the faults of its end

The pytest fixture `evstim_rig` and the keywords for Robot Framework are both made of it.

`write_artefacts` writes the files of a failed test: the rig's last events, its counts and its report. The events are
AEDAT 4.0 where faery is installed, which most viewers open, else an .npz.
"""

from __future__ import annotations

import dataclasses
import json
import threading
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, Self

import msgspec
import numpy as np

from emulator.cli.run import summary
from emulator.light import MachineLacks, SceneError
from emulator.rig.loading import Rig, load_rig
from emulator.rig.tables import Verdict
from emulator.run.assembly import build_scene, is_drawn_here
from emulator.run.machine import on_free_ports
from emulator.run.outcome import Judgement, RunResult, RunStatus, judge
from emulator.run.report.content import Circumstances, ReportContent
from emulator.run.report.files import write_report
from emulator.run.report.modelled import Modelled, modelled
from emulator.run.report.observation import Observation
from evstim.running import LiveRun, run
from firmware_protocol.events import EVENT, Events
from firmware_protocol.recordings.part import Facts, Part
from transports.recording.files import RecordingFile
from transports.recording.format import FORMATS

__all__ = ["RigOptions", "RunningRig", "faults_of_a_run", "on_free_ports", "rules_of_a_test", "write_artefacts"]

_MOST_KEPT = 2_000_000  # events, 26 MB


@dataclasses.dataclass(frozen=True)
class RigOptions:
    """Options of a rig that runs for a test.

    Attributes
    ----------
    seconds : stream time to run for; 0 means until the test ends; None means the rig's own.
    seed : seed of everything random; None means the rig's own.
    pace : "realtime" or "free"; None means the rig's own.
    keep_s : stream time that `recent_events` covers.
    ready_s : how long the links may take to open: the first run on a machine compiles.
    """

    seconds: float | None = 0.0
    seed: int | None = None
    pace: Literal["realtime", "free"] | None = None
    keep_s: float = 2.0
    ready_s: float = 300.0


class RunningRig:
    """A run in this process; use it in a `with` block. Entering it returns when every link is open.

    Parameters
    ----------
    rig : path of a rig file, name of a shipped rig, or a Rig.
    folder : takes the symbolic links of serial lines.

    Attributes
    ----------
    rig : the rig, with the free ports that it has.
    addresses : address of the other side of each link, by the link's name.
    seen : statistics of its events for a report; complete when the run has ended.
    began, ended : dates and times in UTC, for a report; None before.
    """

    def __init__(self, rig: str | Path | Rig, folder: Path, options: RigOptions | None = None) -> None:
        self._options = options or RigOptions()
        loaded = rig if isinstance(rig, Rig) else load_rig(str(rig))
        self.rig = on_free_ports(loaded, folder)
        self.addresses: Mapping[str, str | None] = {}
        self.began: datetime | None = None
        self.ended: datetime | None = None
        o = self._options
        self._live: LiveRun[Events] = run(self.rig, seconds=o.seconds, seed=o.seed, pace=o.pace)
        self.seen = Observation(self.rig.camera.size)
        self._recent: deque[Events] = deque()
        self._recent_count = 0
        self._error: BaseException | None = None
        self._reader = threading.Thread(target=self._read, name=f"events of {self.rig.name}")

    def __enter__(self) -> Self:
        self._live.__enter__()
        self._reader.start()
        try:
            self.addresses = self._live.wait_until_ready(self._options.ready_s)
        except BaseException:
            self._end()
            raise
        self.began = datetime.now(UTC)
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def address(self) -> str:
        """The address of the rig's only link; raises ValueError where there are more, or none."""
        if len(self.addresses) != 1:
            raise ValueError(f"rig {self.rig.name!r} has {len(self.addresses)} links: use `addresses`")
        return next(iter(self.addresses.values())) or ""

    @property
    def status(self) -> RunStatus:
        """Counts and link states now, renewed ten times a second."""
        status = self._live.status
        assert status is not None, "a rig that was entered has a status"
        return status

    @property
    def result(self) -> RunResult:
        """Counts, ledger and link reports; raises RuntimeError before `stop`."""
        return self._live.result

    def inject(self, kind: str, **keys: Any) -> None:
        """Begin a fault within a tenth of a second; `keys` are those of a rig's [[faults]] table."""
        self._live.inject({"kind": kind, **keys})

    def recent_events(self) -> Events:
        """Return the last events of the sensor, (n,) EVENT; a failed test wants to see them."""
        batches = list(self._recent)
        return np.concatenate(batches) if batches else np.zeros(0, EVENT)

    def stop(self) -> RunResult:
        """End the run, and return its result; raises the error of a run that failed."""
        self._end()
        if self._error is not None:
            raise self._error
        return self._live.result

    def _end(self) -> None:
        self._live.stop()
        if self._reader.ident is not None:
            self._reader.join()
        self.ended = self.ended or datetime.now(UTC)

    def _read(self) -> None:
        try:
            for events in self._live:
                self._keep(events)
        except BaseException as error:  # noqa: BLE001 - `stop` raises it in the test's thread
            self._error = error

    def _keep(self, events: Events) -> None:
        self.seen.take(events)
        self._recent.append(events)
        self._recent_count += len(events)
        oldest_us = int(events["t"][-1]) - round(self._options.keep_s * 1e6)
        while self._recent and (self._recent[0]["t"][-1] < oldest_us or self._recent_count > _MOST_KEPT):
            self._recent_count -= len(self._recent.popleft())


def rules_of_a_test(result: RunResult) -> tuple[Judgement, ...]:
    """Return the rules that each run keeps; lateness of a busy machine is not judged, nor is the rig's [verdict]."""
    return judge(Verdict(), dataclasses.replace(result, max_late_us=0.0))


def faults_of_a_run(result: RunResult) -> list[str]:
    """Return the rules that the run of a test has broken, a line each."""
    return [f"{rule.rule}: {rule.finding}" for rule in rules_of_a_test(result) if not rule.good]


def write_artefacts(rig: RunningRig, test: str, folder: Path) -> list[Path]:
    """Write events, summary.json and the report of a rig that has been stopped; return their paths. `test` names it."""
    folder.mkdir(parents=True, exist_ok=True)
    events, counts = _write_events(rig, folder), folder / "summary.json"
    results = msgspec.to_builtins(summary(rig.rig, rig.result))
    counts.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    circumstances = Circumstances(rig.began, rig.ended, _plan_of(rig.rig), test=test)
    judged = (rig.rig, rig.result, rig.seen, rules_of_a_test(rig.result))
    content = ReportContent(*judged, results, version("evstim"), circumstances)
    return [events, counts, *write_report(content, folder)]


def _plan_of(rig: Rig) -> Modelled | None:
    """Return what the run modelled, from its scene built once more; frames of another program do not come again."""
    if not is_drawn_here(rig):
        return modelled(rig, None)
    with suppress(SceneError, MachineLacks, OSError), build_scene(rig) as scene:
        return modelled(rig, scene)
    return None


def _write_events(rig: RunningRig, folder: Path) -> Path:
    form = FORMATS["aedat4" if find_spec("faery") else "npz"]
    path = folder / f"events{form.suffixes[0]}"
    file = RecordingFile(path, form, Facts(size=rig.rig.camera.size, camera=rig.rig.camera.model))
    file.write(Part(events=rig.recent_events()))
    file.close()
    return path
