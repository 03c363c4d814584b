"""`evstim record RIG FILE`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cyclopts import Parameter

from emulator.cli.checks import failures, prepared
from emulator.cli.output import BAD_VERDICT, GOOD, Json, RigName, print_result
from emulator.cli.recordings import check_recording
from emulator.cli.run import rig_with_options, run_rig, summary, summary_lines
from emulator.cli.signals import ignore_stop_signals
from emulator.rig.loading import Rig, load_rig
from emulator.run.kernels import parts_of
from emulator.run.outcome import good, judge
from transports.file import FileLink


@Parameter(name="*")
@dataclass(frozen=True)
class RunOptions:
    """Options of the run.

    Attributes
    ----------
    seconds
        Stream time to record; 0: until Ctrl-C. Default: the rig's.
    seed
        Seed of everything random. Default: the rig's.
    pace
        free: as fast as possible, without loss; realtime: as the camera would send it, with the date in the file.
    """

    seconds: float | None = None
    seed: int | None = None
    pace: Literal["realtime", "free"] = "free"


def record(rig: RigName, file: Path, /, *, to: str = "", course: RunOptions = RunOptions(), json: Json = False) -> int:
    """Record all that a rig's camera sends and the format can hold, without its links: no host is needed.

    Events, triggers, and frames and IMU samples where the rig has them, with the settings that drivers make by default.
    The summary reports data that the format cannot hold. Ctrl-C ends the recording with a sound file.

    Parameters
    ----------
    file
        The recording; its suffix gives the format, see docs/recordings.md.
    to
        Name of the format, where the suffix does not give it: aedat31, evt2, ros1-dvs, ...
    """
    with failures():
        loaded = load_rig(rig)
        absent = _not_recorded(loaded)
        form = check_recording("FILE", file, to).name
        # The file is the only link, without the triggers and cameras of other links.
        link = FileLink(str(file), form, f"{loaded.camera.model.upper()}_{loaded.camera.serial}")
        trigger = None if loaded.trigger is None or loaded.trigger.source else loaded.trigger
        loaded = dataclasses.replace(loaded, links=(link,), faults=(), trigger=trigger, second_camera=None)
        loaded = rig_with_options(loaded, course.seconds, course.seed, course.pace)
        prepared(parts_of(loaded))
        result = run_rig(loaded, show=not json)
    ignore_stop_signals()
    recorded = result.links[FileLink.name]
    troubles = [*([] if recorded.error is None else [recorded.error]), *recorded.file_troubles]
    outcome = f"written to {file}; `evstim info {file}` shows its content"
    if troubles:
        outcome = f"NOT WHOLE: {'; '.join(troubles)}; `evstim info {file}` shows the content of {file}"
    lines = [*summary_lines(loaded, result), *(f"not recorded: {part}" for part in absent), outcome]
    print_result(json, {**summary(loaded, result), "not_recorded": absent}, lines)
    return GOOD if good(judge(loaded.verdict, result)) else BAD_VERDICT


def _not_recorded(rig: Rig) -> list[str]:
    """Return the parts of the rig that a file of one camera without links cannot contain."""
    absent = []
    if rig.trigger is not None and rig.trigger.source:
        absent.append(f"triggers, which come by the bus of the link {rig.trigger.source!r}")
    if rig.second_camera is not None:
        absent.append("the second camera")
    return absent
