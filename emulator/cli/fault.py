"""`evstim fault [KIND]`: a fault on a link of a rig that runs."""

from __future__ import annotations

import time
import tomllib
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from emulator.cli.output import GOOD, LACKING, WRONG_USE, Failure, console, print_json
from emulator.cli.run_output.link_summary import fault_line
from emulator.run.control import NoAnswer, ask, sockets
from transports.faults.script import FaultRecord

__all__ = ["fault"]

_LOOK_PERIOD_S = 0.1
_PATIENCE_S = 20.0  # beyond the fault's own length


def fault(
    kind: str | None = None,
    /,
    *,
    run: str | None = None,
    link: str | None = None,
    for_s: float | None = None,
    keys: Annotated[tuple[str, ...], Parameter(name="--set", negative="")] = (),
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Inject a fault on a link of a rig that runs, and tell what it did. Without a kind: list what can be injected.

    Parameters
    ----------
    kind
        Which fault, such as bit_flips; the rig reference tells them all.
    run
        Name of the rig, where several run; or the path of its socket.
    link
        Which of its links, where several can have this fault.
    for_s
        How long, in stream time.
    keys
        More keys of the fault, as in a rig: --set rate=1e-4 --set count=0.
    json
        Print one JSON object as the last line on stdout.
    """
    path, faults = _find(run)
    if kind is None:
        return _list(faults, json)
    table = {"kind": kind, **_keys(keys)}
    table |= {key: value for key, value in (("link", link), ("for_s", for_s)) if value is not None}
    injected = _ask(path, {"ask": "inject", "fault": table})
    if "error" in injected:
        raise Failure(str(injected["error"]), WRONG_USE)
    record = _follow(path, injected, kind, float(table.get("for_s", 0.0)))
    if json:
        print_json({"link": injected["link"], "fault": record})
    else:
        console.print(f"{injected['link']}: {fault_line(record)}")
    return GOOD


def _find(run: str | None) -> tuple[Path, dict[str, Any]]:
    """Return the socket of the run that is meant, and what it says of its faults."""
    if run is not None and Path(run).is_socket():
        return Path(run), _ask(Path(run), {"ask": "faults"})
    found = []
    for path in sockets():
        try:
            found.append((path, ask(path, {"ask": "faults"})))
        except NoAnswer:
            continue  # of a run that died
    meant = [(path, faults) for path, faults in found if run in (None, faults["rig"])]
    if not meant:
        name = "no rig" if run is None else f"no rig {run!r}"
        raise Failure(f"{name} with a serial or CAN link runs here; start one: evstim run serial-demo", LACKING)
    if len(meant) > 1:
        there = ", ".join(str(path) for path, _ in meant)
        raise Failure(f"several rigs run; say which by --run: its name, or one of {there}", WRONG_USE)
    return meant[0]


def _list(faults: dict[str, Any], json: bool) -> int:
    if json:
        print_json(faults)
        return GOOD
    for name, link in faults["links"].items():
        console.print(f"{faults['rig']}, link {name}: {', '.join(link['kinds']) or 'no faults of this kind of link'}")
        for record in link["injected"]:
            console.print(f"  {fault_line(FaultRecord(**record))}")
    return GOOD


def _keys(keys: tuple[str, ...]) -> dict[str, Any]:
    """Return KEY=VALUE pairs as a table; values as in a rig, and plain words as text."""
    table = {}
    for key in keys:
        name, is_pair, value = key.partition("=")
        if not is_pair:
            raise Failure(f"--set {key}: write it as KEY=VALUE", WRONG_USE)
        try:
            table[name.strip()] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            table[name.strip()] = value
    return table


def _ask(path: Path, message: dict[str, Any]) -> dict[str, Any]:
    try:
        return ask(path, message)
    except NoAnswer as error:
        raise Failure(str(error), LACKING) from error


def _follow(path: Path, injected: dict[str, Any], kind: str, for_s: float) -> FaultRecord:
    """Wait until the fault is over, or patience is, and return what it did."""
    until_s = time.monotonic() + for_s + _PATIENCE_S
    record = None
    while record is None or (record.ended_us is None and time.monotonic() < until_s):
        time.sleep(_LOOK_PERIOD_S)
        records = _ask(path, {"ask": "faults"})["links"][injected["link"]]["injected"][injected["after"] :]
        record = next((FaultRecord(**each) for each in records if each["kind"] == kind), None)
        if record is None and time.monotonic() > until_s:
            raise Failure(f"link {injected['link']!r} did not begin it", LACKING)
    return record
