"""`evstim demo landing`: the landing of examples/landing, flown from start to touchdown."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from emulator.cli.output import BAD_VERDICT, GOOD, LACKING, WRONG_USE, Failure, console, print_json, status

__all__ = ["fly_landing"]

_HEIGHT_M = 60.0
_PARENTS = Path(__file__).parents


def fly_landing(*, as_json: bool) -> int:
    """Fly one landing, its descent on stderr; return the exit code."""
    out = Path(tempfile.mkdtemp(prefix="evstim-landing-"))
    status.print(f"a lander falls from {_HEIGHT_M:g} m, guided by events; about 30 s of flight; files in {out}")
    command = [sys.executable, str(_program()), "--height", str(_HEIGHT_M), "--out", str(out)]
    code = subprocess.run(command, stdout=sys.stderr, check=False).returncode
    file = out / "verdict.json"
    if not file.exists():
        own = code if code in (WRONG_USE, LACKING) else BAD_VERDICT
        raise Failure(f"the landing did not begin: fly.py ended with {code}, see above", own)
    told = json.loads(file.read_text())
    if as_json:
        print_json({**told, "good": told["soft"], "folder": str(out)})
    else:
        _print(told)
    return GOOD if told["soft"] else BAD_VERDICT


def _program() -> Path:
    """Return the example's program: in the package when installed, else in the checkout."""
    for root in (_PARENTS[2] / "evstim" / "examples", _PARENTS[2] / "examples"):
        if (program := root / "landing" / "fly.py").is_file():
            return program
    raise Failure("examples/landing is not here: it comes with evstim and lies in its repository", WRONG_USE)


def _print(told: dict[str, Any]) -> None:
    if told["touched"]:
        console.print(f"touchdown after {told['t_s']:.1f} s at {told['vertical_m_s']:.2f} m/s down")
    if "error_median" in told:
        console.print(f"divergence from events: {100 * told['error_median']:.1f} % off in the median")
    for sentence in told["why"]:
        console.print(sentence, markup=False)
    console.print("good" if told["soft"] else "NOT GOOD: below 1 m/s is a landing")
