"""Puts the verbs together and turns their failures into exit codes.

Exit codes: 0 good; 1 the run's verdict is bad; 2 wrong use or a wrong rig; 3 the machine lacks something.
With `--json` the last line on stdout is one JSON object, also when something went wrong (`{"error": ...}`).
"""

from __future__ import annotations

import logging
import os
import sys
from importlib.metadata import version
from typing import IO, cast

from cyclopts import App, CycloptsError
from rich.logging import RichHandler

from emulator.cli.output import BAD_VERDICT, WRONG_USE, Failure, print_json, status
from transports.link.background_log import BackgroundWriter

__all__ = ["app", "main"]

app = App(
    name="evstim",
    help="An event camera that is not there: a scene, a sensor and a DAVIS346 on USB for the computer under test.",
    help_epilogue="Try:  evstim run eros      evstim demo      evstim run checkerboard --seconds 10 --json",
    version=version("evstim"),
    result_action="return_value",
)
# By name, so that a verb imports no more than it needs: numba and GL make `evstim rigs` wait otherwise.
for verb, module, told in (
    ("run", "run", "Run a rig: render its scene, simulate its sensor, serve its camera."),
    ("demo", "demo", "Run a rig, attach to its camera as a driver does, and compare every event."),
    ("check", "check", "Check a rig file without running it."),
    ("plan", "plan", "Tell what a run will model, and why."),
    ("fault", "fault", "Inject a fault on a link of a rig that runs."),
    ("rigs", "rigs", "List the rigs that come with evstim."),
    ("dbc", "listen.can", "Write the DBC file of a rig's CAN link."),
    ("schema", "rigs", "Print the JSON Schema of rig files."),
    ("picture", "picture", "Write one look at a rig as PNG."),
    ("accuracy", "accuracy", "Chart speed against accuracy, and map where methods fail."),
    ("characterise", "characterise", "Measure a simulated sensor as a laboratory does."),
    ("doctor", "doctor", "Tell what this machine offers and lacks."),
    ("bench", "bench", "Measure the speeds that the docs quote."),
):
    app.command(f"emulator.cli.{module}:{verb}", name=verb, help=told)
app.command(
    "emulator.cli.listen.verbs:verbs",
    name="listen",
    help="Read a camera, real or emulated: on USB (also without the word), or on a line.",
)


def main() -> None:
    """Run the command line and exit with its code."""
    log = BackgroundWriter(2)
    status.file = cast(IO[str], log)  # an stderr that nobody reads must not stop a camera
    try:
        sys.exit(_main(sys.argv[1:]))
    finally:
        log.drain()


def _main(tokens: list[str]) -> int:
    logging.basicConfig(format="%(message)s", handlers=[RichHandler(console=status, show_path=False, show_time=False)])
    for room in ("emulator", "transports"):
        logging.getLogger(room).setLevel(os.environ.get("EVSTIM_LOG", "INFO").upper())
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
    except KeyboardInterrupt:
        return _fail("interrupted", BAD_VERDICT, as_json)


def _fail(message: str, exit_code: int, as_json: bool, told: bool = False) -> int:
    if not told:
        status.print(f"evstim: {message}", markup=False)
    if as_json:
        print_json({"error": message, "exit_code": exit_code})
    return exit_code
