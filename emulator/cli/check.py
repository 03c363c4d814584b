"""`evstim check RIG`: check a rig file."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from emulator.cli.failures import failures
from emulator.cli.output import GOOD, console, print_json
from emulator.rig.loading import Rig, load_rig
from emulator.rig.remarks import open_files, remarks
from emulator.run.scene_assembly import build_scene

__all__ = ["check"]

Json = Annotated[bool, Parameter(negative="")]


def check(rig: str, /, *, draw: Annotated[bool, Parameter(negative="")] = False, json: Json = False) -> int:
    """Check a rig file without running it, and open every file that it names.

    Parameters
    ----------
    rig
        Path of a rig file, or the name of a shipped one.
    draw
        Also build the scene; this reads its files and needs the libraries that draw it.
    json
        Print one JSON object as the last line on stdout.
    """
    with failures():
        loaded = load_rig(rig)
        open_files(loaded)
        notes = remarks(loaded)
        if draw:
            build_scene(loaded).close()
    if json:
        print_json({"rig": loaded.name, "good": True, "title": loaded.title, "notes": notes})
    else:
        console.print(f"{loaded.name}: good. {_sentence(loaded)}")
        for note in notes:
            console.print(f"note: {note}", markup=False)
    return GOOD


def _sentence(rig: Rig) -> str:
    sensor = rig.camera.sensor
    links = ", ".join(link.name for link in rig.links) or "none"
    return (
        f"{type(rig.scene).__name__.removesuffix('Parameters')} seen by a {rig.camera.model} of "
        f"{sensor.width}x{sensor.height} pixels, a step every {rig.run.step_us} us; links: {links}."
    )
