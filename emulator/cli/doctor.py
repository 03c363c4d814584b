"""`evstim doctor [RIG]`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.text import Text

from emulator.cli.checks import failures, prepared
from emulator.cli.output import (
    BAD_VERDICT,
    GOOD,
    LACKING,
    Failure,
    Flag,
    Json,
    console,
    print_json,
    print_result,
    status,
)
from emulator.cli.recordings import check_recording
from emulator.cli.rigs import examined_needs
from emulator.rig.kinds import SCENES
from emulator.rig.loading import Rig, load_rig, shipped_rigs
from emulator.run.assembly import build_scene, plan_of
from emulator.run.kernels import CODER, DECODER, EVT, parts_of, uncompiled
from emulator.run.machine import examine, kernel_cache
from emulator.run.trial import INSTANTS, trial
from transports.needs import Finding


def doctor(
    rig: str | None = None,
    /,
    *,
    prepare: Flag = False,
    every: Annotated[bool, Parameter(name="--all", negative="")] = False,
    json: Json = False,
) -> int:
    """Show which parts this machine has and lacks, with the command that adds each missing part.

    Parameters
    ----------
    rig
        Path of a rig file, or the name of a shipped one: show its needs, and measure whether it runs in real time.
    prepare
        Compile the kernels of this rig and build its scene once, or compile those of all shipped rigs, so that no run
        has to.
    every
        Show each part that this machine has on a line of its own, with its version and its use.
    """
    with failures():
        if prepare:
            _prepare([rig] if rig is not None else [str(path) for path in shipped_rigs().values()])
        if rig is not None:
            return GOOD if prepare and not json else _of_rig(load_rig(rig), as_json=json)
    findings = examine()
    if json:
        print_json({"findings": findings})
    else:
        _print(findings, every=every)
    return GOOD


def _of_rig(rig: Rig, *, as_json: bool) -> int:
    """Show the needs of a rig, compile its kernels and measure its speed; the latter two where nothing is missing."""
    needed = examined_needs(rig)
    lacks = any(need.by == "run" and not need.finding.good for need in needed)
    if not as_json:
        for need in needed:
            console.print(f"{rig.name}: {need.line}", markup=False)
    speed, sentence = None, f"{rig.name} does NOT run on this machine: add the missing parts first"
    if not lacks:
        prepared(parts_of(rig))
        with build_scene(rig) as scene:
            speed = trial(rig, scene, None if SCENES[rig.scene.kind].events else plan_of(rig, scene), INSTANTS)
        sentence = f"{rig.name} {speed.verdict(rig)}"
    value = {
        "findings": [need.finding for need in needed],
        "rig": rig.name,
        "needs": [need.as_json() for need in needed],
        "real_time": None if speed is None else speed.factor > 1,
        "times_real_time": None if speed is None else speed.factor,
        "expected": None if speed is None else speed.as_json(),
    }
    print_result(as_json, value, [sentence])
    return LACKING if speed is None else GOOD if speed.factor > 1 else BAD_VERDICT


def _prepare(names: Sequence[str]) -> None:
    """Compile the kernels of rigs, receivers and formats; build the scene of a single rig, and so fill its cache."""
    rigs = [load_rig(name) for name in names]
    if not (stored := kernel_cache()).good:
        raise Failure(f"--prepare: {stored.detail}", LACKING)
    parts = [part for rig in rigs for part in parts_of(rig)]
    prepared(list({part.key: part for part in (*parts, CODER, DECODER, EVT)}.values()))
    if len(rigs) == 1:
        with build_scene(rigs[0]):
            status.print(f"{rigs[0].name} is prepared", markup=False)


def _print(findings: Sequence[Finding], *, every: bool) -> None:
    """Print what is there and whether README's next step works, then each missing part, or `every` part, on a line."""
    present = ", ".join(finding.name for finding in findings if finding.good)
    console.print(f"there: {present} (`evstim doctor --all` has their versions)", markup=False, highlight=False)
    if (stored := kernel_cache()).good:
        console.print(f"compiled kernels are stored in {stored.detail}", markup=False, highlight=False)
    console.print(_next_step(), markup=False, highlight=False)
    missing = [finding for finding in findings if not finding.good]
    console.print("missing, each for its own use alone:" if missing else "nothing is missing")
    width = max(len(finding.name) for finding in findings)
    for finding in findings if every else missing:
        mark = Text("yes" if finding.good else " no", style="green" if finding.good else "yellow")
        console.print(mark, f" {finding.name:{width}}  {finding.detail}  (for {finding.needed_for})", sep="")
        if finding.fix:
            console.print(f"     {'':{width}}  fix: {finding.fix}", markup=False)


def _next_step() -> str:
    """Return whether the first recording of README works here."""
    try:
        check_recording("`evstim record eros eros.aedat4` does not", Path("eros.aedat4"))
    except Failure as failure:
        return f"`evstim run eros` works here; {failure}"
    first = "; before it, compile: `evstim doctor --prepare eros`" if uncompiled(parts_of(load_rig("eros"))) else ""
    return f"`evstim run eros` and `evstim record eros eros.aedat4` work here{first}"
