"""`evstim check RIG`: check a rig file."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Annotated

from cyclopts import Parameter

from emulator.cli.failures import failures
from emulator.cli.output import GOOD, console, print_json
from emulator.rig.loading import Rig, load_rig
from emulator.rig.remarks import OpenedFile, open_files, remarks
from emulator.rig.scene_kinds import SCENES
from emulator.run.assembly import build_sensor
from emulator.run.scene_assembly import build_scene

__all__ = ["check"]

Json = Annotated[bool, Parameter(negative="")]


def check(rig: str, /, *, draw: Annotated[bool, Parameter(negative="")] = False, json: Json = False) -> int:
    """Check a rig file without running it, and open every file that it names; trajectories are read.

    Parameters
    ----------
    rig
        Path of a rig file, or the name of a shipped one.
    draw
        Also build the scene; this reads its files, or its recording, and needs the libraries that draw it.
    json
        Print one JSON object as the last line on stdout.
    """
    with failures():
        loaded = load_rig(rig)
        files = [dataclasses.replace(file, is_read=file.is_read or draw) for file in open_files(loaded)]
        notes = remarks(loaded)
        if draw:
            _draw(loaded)
    if json:
        print_json({"rig": loaded.name, "good": True, "title": loaded.title, "notes": notes, "files": files})
    else:
        console.print(f"{loaded.name}: good. {_sentence(loaded)}")
        for line in _unread(files):
            console.print(line, markup=False)
        for note in notes:
            console.print(f"note: {note}", markup=False)
    return GOOD


def _draw(rig: Rig) -> None:
    """Read the files of the scene, each within the bounds of its reader."""
    build_scene(rig).close()
    if SCENES[rig.scene.kind].events:
        build_sensor(rig, rig.camera.sensor)


def _unread(files: Sequence[OpenedFile]) -> list[str]:
    """Return a line on the files that were opened and not read, if there are any."""
    told = [f"{file.key} ({file.path}{_size(file)})" for file in files if not file.is_read]
    return [f"opened, not read: {', '.join(told)}; `evstim check --draw` reads them"] if told else []


def _size(file: OpenedFile) -> str:
    return "" if file.bytes is None else f", {file.bytes} bytes"


def _sentence(rig: Rig) -> str:
    sensor = rig.camera.sensor
    links = ", ".join(link.name for link in rig.links) or "none"
    return (
        f"{type(rig.scene).__name__.removesuffix('Parameters')} seen by a {rig.camera.model} of "
        f"{sensor.width}x{sensor.height} pixels, a step every {rig.run.step_us} us; links: {links}."
    )
