"""`evstim rigs` and `evstim schema`: the installed rigs, and the JSON Schema of rig files."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from emulator.cli.failures import failures
from emulator.cli.output import GOOD, console, print_json
from emulator.rig.loading import load_rig, shipped_rigs
from emulator.rig.schema import rig_schema

__all__ = ["rigs", "schema"]

Json = Annotated[bool, Parameter(negative="")]


def rigs(*, json: Json = False) -> int:
    """List the rigs that are installed with evstim.

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


def schema() -> int:
    """Print the JSON Schema of rig files, for editors."""
    print_json(rig_schema())
    return GOOD
