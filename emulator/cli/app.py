"""The application: all commands, and the exit codes of their failures.

Exit codes: 0 good; 1 the verdict of the run is bad; 2 wrong use or wrong rig; 3 the machine lacks something, or stdout
cannot take the result. With `--json` the last line on stdout is one JSON object, also after an error
(`{"error": ...}`).
"""

from __future__ import annotations

import gc
import logging
import os
import sys
from importlib.metadata import version
from importlib.util import resolve_name
from typing import IO, cast

from cyclopts import App, CycloptsError, Group

from emulator.cli.output import (
    BAD_VERDICT,
    GOOD,
    WRONG_USE,
    Failure,
    break_lines,
    console,
    guard_stdout,
    help_console,
    log_handler,
    print_json,
    status,
)
from emulator.cli.signals import ignore_stop_signals
from transports.link.background_log import BackgroundWriter

app = App(
    name="evstim",
    help="Emulate an event camera: render a scene, simulate the sensor, send its events over USB, serial lines or CAN.",
    help_epilogue="With --quiet a command prints its result and errors alone.  "
    "Try:  evstim run eros      evstim demo      evstim run checkerboard --seconds 10 --json",
    version=version("evstim"),
    result_action="return_value",
    suppress_keyboard_interrupt=False,  # it would exit with 130, without a message
)
# Module by name, so that a command imports only its own modules: numba and GL would slow `evstim rigs` down.
_COMMANDS = {
    "Run and read": (
        ("demo", ".demo:demo", "Run a rig, read its camera over USB/IP in a second process, and compare every event."),
        ("run", ".run:run", "Run a rig: render its scene, simulate its sensor, serve its links."),
        (
            "listen",
            ".listen.cameras:verbs",
            "Read a camera, real or emulated: on USB (the default), a serial line or a CAN bus.",
        ),
        ("picture", ".picture:picture", "Write a picture or movie of a rig or a recording: its light and its events."),
        ("doctor", ".doctor:doctor", "Show which parts this machine has and lacks, with the command that adds each."),
    ),
    "Rigs": (
        ("rigs", ".rigs:rigs", "List the rigs that are installed with evstim."),
        ("check", ".rigs:check", "Check a rig file without running it."),
        ("plan", ".plan:plan", "Show the plan of a run: step, effects and expected load."),
        ("schema", ".rigs:schema", "Print the JSON Schema of rig files, or of reports."),
    ),
    "While a rig runs": (
        ("fault", ".fault:fault", "Inject a fault into a link of a running rig."),
        ("trigger", ".fault:trigger", "Give the camera of a running rig an edge, or reset its clock."),
        (
            "dynamics",
            ".dynamics:dynamics",
            "Fly an FMU: its poses go to a running rig, its inputs come from a file or a CAN bus.",
        ),
        (
            "vizard",
            ".vizard:vizard",
            "Run a rig in step with a Basilisk simulation, which sends poses and requests images.",
        ),
    ),
    "Recordings": (
        ("record", ".record:record", "Record the events of a rig to a file: AEDAT4, EVT3, HDF5, a ROS bag, ..."),
        ("info", ".info:info", "Show the format and the content of a recording of events."),
        ("convert", ".convert:convert", "Convert a recording of events to another format."),
        ("recover", ".convert:recover", "Save the readable part of a recording that was cut."),
    ),
    "Measure": (
        (
            "campaign",
            ".campaign:verbs",
            "Run a rig many times over sampled parameters, and report on the table of all runs.",
        ),
        (
            "accuracy",
            "laboratory.verbs.accuracy:verbs",
            "Measure accuracy against speed, where each method fails, and other simulators on the same scenes.",
        ),
        (
            "characterise",
            "laboratory.verbs.characterise:characterise",
            "Measure a simulated sensor with the methods of a laboratory.",
        ),
        (
            "validate",
            "laboratory.verbs.validate:validate",
            "Repeat public measurements of real cameras on the simulated sensors.",
        ),
        ("bench", "laboratory.verbs.bench:verbs", "Measure the speeds that the documentation quotes."),
    ),
    "Connect": (
        (
            "gadget",
            ".gadget:verbs",
            "Make or remove the USB gadget for a camera on a real cable, at a machine with a USB device port.",
        ),
        ("dbc", ".listen.can:dbc", "Write the DBC file of a rig's CAN link."),
        ("export", ".export:export", "Write the packets' definitions for COSMOS, Yamcs, F Prime or Wireshark."),
    ),
}
_TASKS = """\
evstim emulates an event camera: it renders a scene, simulates the sensor, and sends its events over the camera's links.

  evstim demo                      a camera, a program that reads it, and every event compared
  evstim run eros                  a camera on USB/IP, until Ctrl-C; with --serve also a live page in the browser
  evstim listen                    the events that it sends, in a second terminal
  evstim record eros eros.aedat4   the events as a file
  evstim check my.toml             a rig file of your own; `evstim rigs` lists the installed ones

All commands: evstim --help. Parts that this machine lacks: evstim doctor."""


def _add_commands() -> None:
    for sort_key, (title, commands) in enumerate(_COMMANDS.items()):
        group = Group(title, sort_key=sort_key)
        for verb, target, summary in commands:
            app.command(resolve_name(target, "emulator.cli"), name=verb, help=summary, group=group)


_add_commands()
_OPTIONS = Group("Options", sort_key=len(_COMMANDS))
app.register_install_completion_command(group=_OPTIONS)
for flag in ("--help", "--version"):
    app[flag].group = (_OPTIONS,)


def main() -> None:
    """Run the command line and exit with its code."""
    guard_stdout()
    log = BackgroundWriter(2)
    status.file = cast(IO[str], log)  # an unread stderr must not stop a camera
    try:
        sys.exit(_main(sys.argv[1:]))
    finally:
        ignore_stop_signals()
        log.drain()
        gc.freeze()  # a last search for garbage takes a second, and the process ends


def _main(tokens: list[str]) -> int:
    logging.basicConfig(format="%(message)s", handlers=[log_handler()])
    for package in ("emulator", "transports"):
        logging.getLogger(package).setLevel(os.environ.get("EVSTIM_LOG", "INFO").upper())
    as_json = "--json" in tokens
    boxed = break_lines() and not as_json
    if "--quiet" in tokens:
        tokens = [token for token in tokens if token != "--quiet"]
        _be_quiet()
    try:
        return _exit_code(tokens, as_json, boxed)
    except CycloptsError as error:
        return _fail(str(error), WRONG_USE, as_json, printed=boxed)
    except Failure as failure:
        return _fail(str(failure), failure.exit_code, as_json)
    except KeyboardInterrupt:
        ignore_stop_signals()
        return _fail("interrupted", BAD_VERDICT, as_json)


def _exit_code(tokens: list[str], as_json: bool, boxed: bool) -> int:
    """Run a command and flush its whole result; raises Failure when the result cannot be written.

    `boxed`: wrong use is printed by cyclopts, in a box.
    """
    if not tokens:
        console.print(_TASKS, highlight=False, markup=False, soft_wrap=True)
        return GOOD
    if as_json and "--version" in tokens:
        print_json({"name": "evstim", "version": version("evstim")})
        return GOOD
    code = int(app(tokens, console=help_console(app), exit_on_error=False, print_error=boxed) or GOOD)
    if sys.stdout is not None:
        sys.stdout.flush()
    return code


def _be_quiet() -> None:
    """Leave out progress, notices and warnings on stderr; errors and results stay."""
    status.quiet = True


def _fail(message: str, exit_code: int, as_json: bool, printed: bool = False) -> int:
    if not printed:
        status.quiet = False
        status.print(f"evstim: {message}", markup=False)
    if as_json and sys.stdout is not None:
        _print_error({"error": message, "exit_code": exit_code})
    return exit_code


def _print_error(error: dict[str, object]) -> None:
    """Print the JSON of an error; stdout that cannot take it changes neither the message nor the exit code."""
    try:
        print_json(error)
    except Failure as failure:
        status.print(f"evstim: {failure}", markup=False)
