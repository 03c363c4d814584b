"""Puts the verbs together and turns their failures into exit codes.

Exit codes: 0 good; 1 the run's verdict is bad; 2 wrong use or a wrong rig; 3 the machine lacks something.
With `--json` the last line on stdout is one JSON object, also when something went wrong (`{"error": ...}`).
"""

from __future__ import annotations

import logging
import os
import sys
from importlib.metadata import version

from cyclopts import App, CycloptsError
from rich.logging import RichHandler

from emulator.cli import bench, demo, doctor, listen, picture, rigs, run
from emulator.cli.output import WRONG_USE, Failure, print_json, status

__all__ = ["app", "main"]

app = App(
    name="evstim",
    help="An event camera that is not there: a scene, a sensor and a DAVIS346 on USB for the computer under test.",
    help_epilogue="Try:  evstim run eros      evstim demo      evstim run checkerboard --seconds 10 --json",
    version=version("evstim"),
    result_action="return_value",
)
for verb in (
    run.run,
    demo.demo,
    listen.listen,
    rigs.check,
    rigs.rigs,
    rigs.schema,
    picture.picture,
    doctor.doctor,
    bench.bench,
):
    app.command(verb)


def main() -> None:
    """Run the command line and exit with its code."""
    sys.exit(_main(sys.argv[1:]))


def _main(tokens: list[str]) -> int:
    level = os.environ.get("EVSTIM_LOG", "WARNING").upper()
    logging.basicConfig(level=level, format="%(message)s", handlers=[RichHandler(console=status, show_path=False)])
    as_json = "--json" in tokens
    if as_json and "--version" in tokens:
        print_json({"name": "evstim", "version": version("evstim")})
        return 0
    try:
        return int(app(tokens, exit_on_error=False, print_error=not as_json) or 0)
    except CycloptsError as error:
        return _fail(str(error), WRONG_USE, as_json, told=not as_json)
    except Failure as failure:
        return _fail(str(failure), failure.exit_code, as_json)


def _fail(message: str, exit_code: int, as_json: bool, told: bool = False) -> int:
    if not told:
        status.print(f"evstim: {message}", markup=False)
    if as_json:
        print_json({"error": message, "exit_code": exit_code})
    return exit_code
