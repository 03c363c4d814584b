"""`evstim fault [KIND]`: inject a fault into a link of a running rig.

`evstim trigger [KIND]`: an edge at the camera's input of a running rig, or a reset of its clock.
"""

from __future__ import annotations

import os
import time
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from emulator.cli.output import GOOD, LACKING, WRONG_USE, Failure, Json, failing, print_result
from emulator.cli.run_summary import fault_line
from emulator.run.control import NoAnswer, send_request, sockets
from transports.faults.script import FaultRecord

_RUN_HELP = """Name of the rig, its process number, or the path of its control socket. Needed if several rigs run, or if
the one that runs was started in another folder."""
_RunName = Annotated[str | None, Parameter(help=_RUN_HELP)]
_POLL_PERIOD_S = 0.1
_TIMEOUT_S = 20.0  # beyond the fault's own length


def fault(
    kind: str | None = None,
    /,
    *,
    run: _RunName = None,
    link: str | None = None,
    for_s: float | None = None,
    keys: Annotated[tuple[str, ...], Parameter(name="--set", negative="")] = (),
    json: Json = False,
) -> int:
    """Inject a fault into a link of a running rig and show its effect. Without a kind: list the possible faults.

    Parameters
    ----------
    kind
        Kind of fault, such as bit_flips; the rig reference lists all.
    link
        Name of the link if several can have this fault.
    for_s
        Duration in stream time, seconds.
    keys
        Further keys of the fault, as in a rig: --set rate=1e-4 --set count=0.
    """
    path, faults = find_run(run)
    if kind is None:
        print_result(json, faults, _listed(faults))
        return GOOD
    table = {"kind": kind, **keys_of(keys)}
    table |= {key: value for key, value in (("link", link), ("for_s", for_s)) if value is not None}
    injected = answer_of(path, {"request": "inject", "fault": table})
    record = _follow(path, injected, kind, float(table.get("for_s", 0.0)))
    lines = [f"{_origin(faults)}, {injected['link']}: {fault_line(record)}"]
    if not record.hits:
        state = str(answer_of(path, {"request": "faults"})["links"][injected["link"]].get("state", ""))
        waiting = f"because nothing was sent: the link is {state}"
        unlucky = "nothing was sent while it lasted, or its rate is low; a longer --for-s or a higher rate hits more"
        lines.append(f"0 hits, {waiting}" if "waiting" in state else f"0 hits: {unlucky}")
    result = {"rig": faults["rig"], "pid": faults["pid"], "link": injected["link"], "fault": record}
    print_result(json, result, lines)
    return GOOD


def find_run(run: str | None) -> tuple[Path, dict[str, Any]]:
    """Return the control socket of the chosen run, and its answer about faults."""
    if run is not None and Path(run).is_socket():
        return Path(run), answer_of(Path(run), {"request": "faults"})
    runs = []
    for path in sockets():
        with suppress(NoAnswer):  # its run has died
            runs.append((path, send_request(path, {"request": "faults"})))
    meant = [(path, faults) for path, faults in runs if run in (None, faults["rig"], str(faults["pid"]))]
    if not meant:
        name = "no rig" if run is None else f"no rig {run!r}"
        raise Failure(f"{name} is running; start one: evstim run serial-demo", LACKING)
    origins = "; ".join(f"{_origin(faults)} in {faults['folder']}" for _, faults in meant)
    if len(meant) > 1:
        raise Failure(f"several rigs are running: {origins}; choose one with --run and its name or process", WRONG_USE)
    if run is None and meant[0][1]["folder"] != os.getcwd():
        advice = f"if it is meant, add --run {meant[0][1]['rig']}"
        raise Failure(f"{origins} was started in another folder: {advice}", WRONG_USE)
    return meant[0]


def _origin(faults: dict[str, Any]) -> str:
    """Return the rig and the process that gave an answer."""
    return f"{faults['rig']} (process {faults['pid']})"


def _listed(faults: dict[str, Any]) -> Iterator[str]:
    for name, link in faults["links"].items():
        yield f"{_origin(faults)}, link {name}: {', '.join(link['kinds']) or 'no faults for this kind of link'}"
        for record in link["injected"]:
            yield f"  {fault_line(FaultRecord(**record))}"


def keys_of(keys: tuple[str, ...]) -> dict[str, Any]:
    """Return KEY=VALUE pairs as a table; values as in a rig, and plain words as text."""
    table = {}
    for key in keys:
        name, is_pair, value = key.partition("=")
        if not is_pair:
            raise Failure(f"--set {key}: KEY=VALUE is needed", WRONG_USE)
        try:
            table[name.strip()] = tomllib.loads(f"value = {value}")["value"]
        except (ValueError, RecursionError):  # no TOML
            table[name.strip()] = value
    return table


def answer_of(path: Path, message: dict[str, Any]) -> dict[str, Any]:
    """Return the answer of a run to a request; raises Failure where there is none, or it is an error."""
    with failing(LACKING, NoAnswer):
        answer = send_request(path, message)
    if "error" in answer:
        raise Failure(str(answer["error"]), WRONG_USE)
    return answer


def _follow(path: Path, injected: dict[str, Any], kind: str, for_s: float) -> FaultRecord:
    """Wait for the end of the fault, within a limit, and return its record."""
    until_s = time.monotonic() + for_s + _TIMEOUT_S
    record = None
    while record is None or (record.ended_us is None and time.monotonic() < until_s):
        time.sleep(_POLL_PERIOD_S)
        records = answer_of(path, {"request": "faults"})["links"][injected["link"]]["injected"][injected["after"] :]
        record = next((FaultRecord(**fields) for fields in records if fields["kind"] == kind), None)
        if record is None and time.monotonic() > until_s:
            raise Failure(f"link {injected['link']!r} did not begin the fault", LACKING)
    return record


def trigger(
    kind: Literal["pulse", "rising", "falling", "reset"] = "pulse",
    /,
    *,
    run: _RunName = None,
    link: str | None = None,
    json: Json = False,
) -> int:
    """Give the external input of the cameras of a running rig an edge, or reset their clocks.

    Parameters
    ----------
    kind
        pulse, rising or falling: the edge at the input; reset: device time restarts at zero.
    link
        Name of the link of one camera; without it, all cameras.
    """
    path, faults = find_run(run)
    message: dict[str, Any] = {"request": "trigger", "kind": kind}
    answer = answer_of(path, message if link is None else message | {"link": link})
    result = {"rig": faults["rig"], "pid": faults["pid"], "kind": kind, **answer}
    print_result(json, result, [f"{_origin(faults)}: {kind} at {', '.join(answer['links'])}"])
    return GOOD
