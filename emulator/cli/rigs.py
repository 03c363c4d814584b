"""`evstim rigs` and `evstim schema`: the installed rigs, and the JSON Schema of rig files."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from emulator.cli.failures import failures
from emulator.cli.needed import what_is_needed
from emulator.cli.output import GOOD, console, print_json
from emulator.rig.loading import load_rig, shipped_rigs
from emulator.rig.schema import rig_schema

__all__ = ["rigs", "schema"]

Json = Annotated[bool, Parameter(negative="")]


def rigs(*, json: Json = False) -> int:
    """List the rigs that are installed with evstim, and what each needs beyond evstim's base dependencies.

    Parameters
    ----------
    json
        Print one JSON object as the last line on stdout.
    """
    with failures():
        loaded = {path: load_rig(str(path)) for path in shipped_rigs().values()}
        found = [(path, rig, what_is_needed(rig)) for path, rig in loaded.items()]
    if json:
        print_json({
            "rigs": [
                {"name": rig.name, "title": rig.title, "path": path, "needs": [one.as_json() for one in needed]}
                for path, rig, needed in found
            ]
        })  # fmt: skip
        return GOOD
    width = max(len(rig.name) for _, rig, _ in found)
    for _, rig, needed in found:
        console.print(f"{rig.name:{width}}  {rig.title}")
        for one in needed:
            console.print(f"{'':{width}}  {one.line}", markup=False)
    return GOOD


def schema() -> int:
    """Print the JSON Schema of rig files, for editors."""
    print_json(rig_schema())
    return GOOD
