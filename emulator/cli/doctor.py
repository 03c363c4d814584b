"""`evstim doctor`."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter
from rich.text import Text

from emulator.cli.output import GOOD, console, print_json
from emulator.run.machine import examine

__all__ = ["doctor"]


def doctor(*, json: Annotated[bool, Parameter(negative="")] = False) -> int:
    """Show what this machine has and lacks, with the command that adds each missing part.

    Parameters
    ----------
    json
        Print one JSON object as the last line on stdout.
    """
    findings = examine()
    if json:
        print_json({"findings": findings})
        return GOOD
    width = max(len(finding.name) for finding in findings)
    for finding in findings:
        mark = Text("yes" if finding.good else " no", style="green" if finding.good else "yellow")
        console.print(mark, f" {finding.name:{width}}  {finding.detail}  (for {finding.needed_for})", sep="")
        if finding.fix:
            console.print(f"     {'':{width}}  fix: {finding.fix}")
    return GOOD
