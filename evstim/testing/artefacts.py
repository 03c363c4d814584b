"""Files of a failed test: the rig's last events, its counts and its report.

The events are AEDAT 4.0 where faery is installed, which most viewers open, else an .npz. This is a module of its own
because it loads the emulator, which a pytest session without a failed rig does not need.
"""

from __future__ import annotations

import json
from contextlib import suppress
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import msgspec

from emulator.cli.run import summary
from emulator.light import MachineLacks, SceneError
from emulator.rig.loading import Rig
from emulator.run.assembly import build_scene
from emulator.run.report.content import Circumstances, ReportContent
from emulator.run.report.files import write_report
from emulator.run.report.modelled import Modelled, is_drawn_here, modelled
from evstim.testing.running_rig import RunningRig, rules_of_a_test
from transports.recording.files import RecordingFile
from transports.recording.format import FORMATS
from transports.recording.part import Facts, Part


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
