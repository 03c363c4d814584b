"""`evstim rigs`, `evstim check RIG`, `evstim schema`: what can be run, and whether a rig is right."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from emulator.cli.failures import failures
from emulator.cli.output import GOOD, console, print_json
from emulator.rig import Rig, load_rig, shipped_rigs
from emulator.rig_schema import rig_schema
from emulator.scene_assembly import build_scene

__all__ = ["check", "rigs", "schema"]

Json = Annotated[bool, Parameter(negative="")]


def rigs(*, json: Json = False) -> int:
    """List the rigs that come with evstim.

    Parameters
    ----------
    json
        Print one JSON object as the last line on stdout.
    """
    with failures():
        titles = {name: load_rig(str(path)).title for name, path in shipped_rigs().items()}
    if json:
        print_json({"rigs": [{"name": n, "title": t, "path": shipped_rigs()[n]} for n, t in titles.items()]})
        return GOOD
    width = max(map(len, titles))
    for name, title in titles.items():
        console.print(f"{name:{width}}  {title}")
    return GOOD


def check(rig: str, /, *, draw: Annotated[bool, Parameter(negative="")] = False, json: Json = False) -> int:
    """Check a rig file without running it.

    Parameters
    ----------
    rig
        Path of a rig file, or the name of a shipped one.
    draw
        Also build the scene, which reads its mesh and needs a GL library where the scene does.
    json
        Print one JSON object as the last line on stdout.
    """
    with failures():
        loaded = load_rig(rig)
        if draw:
            build_scene(loaded).close()
    if json:
        print_json({"rig": loaded.name, "good": True, "title": loaded.title})
    else:
        console.print(f"{loaded.name}: good. {_sentence(loaded)}")
    return GOOD


def _sentence(rig: Rig) -> str:
    sensor = rig.camera.sensor
    links = ", ".join(link.name for link in rig.links) or "none"
    return (
        f"{type(rig.scene).__name__.removesuffix('Parameters')} seen by a {rig.camera.model} of "
        f"{sensor.width}x{sensor.height} pixels, a step every {rig.run.step_us} us; links: {links}."
    )


def schema() -> int:
    """Print the JSON Schema of rig files, for editors."""
    print_json(rig_schema())
    return GOOD
