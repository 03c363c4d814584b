"""`evstim doctor [RIG]`."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter
from rich.text import Text

from emulator.cli.failures import failures
from emulator.cli.output import BAD_VERDICT, GOOD, console, print_json
from emulator.cli.preparing import prepared
from emulator.rig.loading import Rig, load_rig, shipped_rigs
from emulator.run.keeping_up import KeepingUp, keeping_up
from emulator.run.kernels import CODER, DECODER, EVT, Part, parts_of
from emulator.run.machine import Finding, examine

__all__ = ["doctor"]


def doctor(
    rig: str | None = None,
    /,
    *,
    prepare: Annotated[bool, Parameter(negative="")] = False,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Show what this machine has and lacks, with the command that adds each missing part.

    Parameters
    ----------
    rig
        Path of a rig file, or the name of a shipped one: measure whether it runs in real time here.
    prepare
        Compile the kernels of this rig, or of all shipped rigs, so that no run has to.
    json
        Print one JSON object as the last line on stdout.
    """
    with failures():
        loaded = None if rig is None else load_rig(rig)
        if prepare or loaded:
            prepared(_parts(loaded))
        speed = None if loaded is None else keeping_up(loaded)
    findings = examine() if rig is None else []
    if json:
        print_json({"findings": findings, **({} if loaded is None or speed is None else _as_json(loaded, speed))})
    else:
        _print(findings)
        if loaded and speed:
            console.print(_sentence(loaded, speed))
    return GOOD if speed is None or speed.good else BAD_VERDICT


def _parts(rig: Rig | None) -> list[Part]:
    """Return what the rig compiles; without a rig what all shipped ones compile, and the receivers and files."""
    if rig is not None:
        return parts_of(rig)
    parts = [part for path in shipped_rigs().values() for part in parts_of(load_rig(str(path)))]
    once = {part.key: part for part in (*parts, CODER, DECODER, EVT)}
    return list(once.values())


def _as_json(rig: Rig, speed: KeepingUp) -> dict[str, object]:
    return {
        "rig": rig.name,
        "real_time": speed.good,
        "times_real_time": speed.times_real_time,
        "planned_load": speed.planned_load,
    }


def _sentence(rig: Rig, speed: KeepingUp) -> str:
    verdict = "runs in real time on this machine" if speed.good else "does NOT run in real time on this machine"
    load = "" if speed.planned_load is None else f"; its plan expects {speed.planned_load:.2f} of a core"
    advice = "" if speed.good else ". Take a longer run.step_us or a smaller camera; `evstim plan` tells the costs"
    return (
        f"{rig.name} {verdict}: {speed.stream_s:.2g} s of stream at {speed.times_real_time:.2f} times real time, "
        f"without links{load}{advice}"
    )


def _print(findings: list[Finding]) -> None:
    width = max((len(finding.name) for finding in findings), default=0)
    for finding in findings:
        mark = Text("yes" if finding.good else " no", style="green" if finding.good else "yellow")
        console.print(mark, f" {finding.name:{width}}  {finding.detail}  (for {finding.needed_for})", sep="")
        if finding.fix:
            console.print(f"     {'':{width}}  fix: {finding.fix}", markup=False)
