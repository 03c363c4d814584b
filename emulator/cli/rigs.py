"""`evstim rigs`, `evstim check RIG`, `evstim schema`: installed rigs, the check of a rig file, and JSON Schemas.

The needs of a rig, with the state of this machine, are shown by `evstim rigs` and `evstim doctor RIG`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from emulator.cli.checks import failures
from emulator.cli.output import GOOD, Flag, Json, RigName, print_json, print_result
from emulator.rig.kinds import SCENES
from emulator.rig.loading import Rig, load_rig, shipped_rigs
from emulator.rig.remarks import OpenedFile, open_files, remarks
from emulator.rig.top_level import rig_schema
from emulator.run.assembly import build_scene, build_sensor, loads_of
from emulator.run.machine import needs_of
from emulator.run.report.content import report_schema
from transports.needs import By, Finding

_WORDS = {"run": "needs", "driver": "drivers on this machine need"}


@dataclass(frozen=True)
class Needed:
    """One thing that a rig needs; `by` as in `transports.needs.Need`."""

    name: str
    by: By
    finding: Finding

    @property
    def line(self) -> str:
        """Line for people, with the command that adds the part where it is missing."""
        state = "there" if self.finding.good else f"missing; {self.finding.fix}"
        return f"{_WORDS[self.by]} the {self.name}: {state}"

    def as_json(self) -> dict[str, object]:
        """Return the need for JSON; `fix` is a shell command, null where the thing is there."""
        return {"name": self.name, "by": self.by, "good": self.finding.good, "fix": self.finding.fix}


def examined_needs(rig: Rig) -> tuple[Needed, ...]:
    """Return the needs of a rig, with the state of this machine."""
    return tuple(Needed(need.name, need.by, need.look()) for need in needs_of(rig))


def rigs(*, json: Json = False) -> int:
    """List the rigs that are installed with evstim, and the needs of each beyond evstim's base dependencies."""
    with failures():
        loaded = {path: load_rig(str(path)) for path in shipped_rigs().values()}
        shipped = [(path, rig, examined_needs(rig)) for path, rig in loaded.items()]
    rows = [
        {"name": rig.name, "title": rig.title, "path": path, "needs": [need.as_json() for need in needed]}
        for path, rig, needed in shipped
    ]
    width, lines = max(len(rig.name) for _, rig, _ in shipped), list[str]()
    for _, rig, needed in shipped:
        lines += [f"{rig.name:{width}}  {rig.title}", *(f"{'':{width}}  {need.line}" for need in needed)]
    print_result(json, {"rigs": rows}, lines)
    return GOOD


def schema(of: Literal["rig", "report"] = "rig", /) -> int:
    """Print the JSON Schema of rig files, for editors, or that of report.json.

    Parameters
    ----------
    of
        Kind of file: "rig", or "report" for the report.json of `evstim run --report`.
    """
    print_json(rig_schema() if of == "rig" else report_schema())
    return GOOD


def check(rig: RigName, /, *, draw: Flag = False, json: Json = False) -> int:
    """Check a rig file without running it, and open every file that it names; trajectories are read.

    Parameters
    ----------
    draw
        Also build the scene; this reads its files, or its recording, and needs the libraries that render it.
    """
    with failures():
        loaded = load_rig(rig)
        files = [dataclasses.replace(file, is_read=file.is_read or draw) for file in open_files(loaded)]
        notes, loads = remarks(loaded), loads_of(loaded)
        if draw:  # the files of the scene are read, each within the bounds of its reader
            with build_scene(loaded) as scene:
                loads = loads_of(loaded, scene)
            if SCENES[loaded.scene.kind].events:
                build_sensor(loaded, loaded.camera.sensor)
    lines = [
        f"{loaded.name}: good. {_sentence(loaded)}",
        *_unread(files),
        *(load.line for load in loads),
        *(f"note: {note}" for note in notes),
    ]
    result = {"rig": loaded.name, "good": True, "title": loaded.title, "notes": notes, "files": files, "lines": loads}
    print_result(json, result, lines)
    return GOOD


def _unread(files: Sequence[OpenedFile]) -> list[str]:
    """Return a line on the files that were opened and not read, if there are any."""
    sizes = {file.key: "" if file.bytes is None else f", {file.bytes} bytes" for file in files}
    names = [f"{file.key} ({file.path}{sizes[file.key]})" for file in files if not file.is_read]
    return [f"opened, not read: {', '.join(names)}; `evstim check --draw` reads them"] if names else []


def _sentence(rig: Rig) -> str:
    sensor = rig.camera.sensor
    links = ", ".join(link.name for link in rig.links) or "none"
    return (
        f"{type(rig.scene).__name__.removesuffix('Parameters')} seen by a {rig.camera.model} of "
        f"{sensor.width}x{sensor.height} pixels, a step every {rig.run.step_us} us; links: {links}."
    )
