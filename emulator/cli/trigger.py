"""`evstim trigger [KIND]`: an edge at the camera's input of a running rig, or a reset of its clock."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from cyclopts import Parameter

from emulator.cli.fault import asked, find_run
from emulator.cli.output import GOOD, WRONG_USE, Failure, console, print_json

__all__ = ["trigger"]


def trigger(
    kind: Literal["pulse", "rising", "falling", "reset"] = "pulse",
    /,
    *,
    run: str | None = None,
    link: str | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Let an edge come to the external input of the cameras of a running rig, or reset their clocks.

    Parameters
    ----------
    kind
        pulse, rising or falling: what happens at the input; reset: device time starts anew at zero.
    run
        Name of the rig if several run; or the path of its control socket.
    link
        Name of the link whose camera is meant; without it, all.
    json
        Print one JSON object as the last line on stdout.
    """
    path, _ = find_run(run)
    question: dict[str, Any] = {"ask": "trigger", "kind": kind}
    answer = asked(path, question if link is None else question | {"link": link})
    if "error" in answer:
        raise Failure(str(answer["error"]), WRONG_USE)
    if json:
        print_json({"kind": kind, **answer})
    else:
        console.print(f"{kind}: {', '.join(answer['links'])}", markup=False)
    return GOOD
