"""The application: all commands, and the exit codes of their failures.

Exit codes: 0 good; 1 the verdict of the run is bad; 2 wrong use or wrong rig; 3 the machine lacks something, or stdout
cannot take the result; 141 stdout has no reader any more. With `--json` the last line on stdout is one JSON object,
also after an error (`{"error": ...}`).
"""

from __future__ import annotations

import gc
import logging
import os
import sys
from importlib.metadata import version
from typing import IO, cast

from cyclopts import App, CycloptsError, Group

from emulator.cli.output import (
    BAD_VERDICT,
    GOOD,
    LACKING,
    UNREAD,
    WRONG_USE,
    Failure,
    console,
    guard_stdout,
    help_console,
    log_handler,
    print_json,
    status,
)
from emulator.cli.signals import ignore_stop_signals, interrupt_on_stop_signals, interruption
from emulator.cli.verbs import VERBS, Verb
from transports.link.background_log import BackgroundWriter
from transports.registry import PluginError

app = App(
    name="evstim",
    help="Emulate an event camera: render a scene, simulate the sensor, send its events over USB, serial lines or CAN.",
    help_epilogue="With --quiet a command prints its result and errors alone.  "
    "Try:  evstim run eros      evstim demo      evstim run checkerboard --seconds 10 --json",
    version=version("evstim"),
    result_action="return_value",
    suppress_keyboard_interrupt=False,  # it would exit with 130, without a message
)
_TASKS = """\
evstim emulates an event camera: it renders a scene, simulates the sensor, and sends its events over the camera's links.

  evstim demo                      a camera, a program that reads it, and every event compared
  evstim run eros                  a camera on USB/IP, until Ctrl-C; with --serve also a live page in the browser
  evstim listen                    the events that it sends, in a second terminal
  evstim record eros eros.aedat4   the events as a file
  evstim check my.toml             a rig file of your own; `evstim rigs` lists the installed ones

All commands: evstim --help. Parts that this machine lacks: evstim doctor."""


_GROUPS: dict[str, Group] = {}


def _add(verb: Verb) -> None:
    group = _GROUPS.setdefault(verb.group, Group(verb.group, sort_key=len(_GROUPS)))
    app.command(verb.command, name=verb.name, help=verb.help, group=group)


for name in VERBS.built_in_names:
    _add(VERBS[name])
_OPTIONS = Group("Options", sort_key=1000)  # after all verbs
app.register_install_completion_command(group=_OPTIONS)
for flag in ("--help", "--version"):
    app[flag].group = (_OPTIONS,)


def _add_verbs_of_packages(name: str) -> None:
    """Add the verb of this name from an installed package, or those of all packages where none has it.

    Raises Failure if the verb cannot be loaded; of several, those that cannot be are left out with a warning.
    """
    names = [name] if name in VERBS else [other for other in VERBS if other not in VERBS.built_in_names]
    for verb_name in names:
        try:
            verb = VERBS[verb_name]
            VERBS.imported(verb_name, verb.command)
        except PluginError as error:
            if verb_name == name:
                raise Failure(str(error), LACKING) from error
            logging.getLogger(__name__).warning("%s", error)
            continue
        if verb_name not in app:
            _add(verb)


def main() -> None:
    """Run the command line and exit with its code."""
    guard_stdout()
    log = BackgroundWriter(2)
    status.file = cast(IO[str], log)  # an unread stderr must not stop a camera
    tokens = sys.argv[1:]
    try:
        interrupt_on_stop_signals()
        code = _main(tokens)
        ignore_stop_signals()
    except KeyboardInterrupt:  # before the command, after it, or while its failure is reported
        code = _interrupted("--json" in tokens)
    finally:
        log.drain()
    gc.freeze()  # a last search for garbage takes a second, and the process ends
    sys.exit(code)


def _main(tokens: list[str]) -> int:
    logging.basicConfig(format="%(message)s", handlers=[log_handler()])
    for package in ("emulator", "transports"):
        logging.getLogger(package).setLevel(os.environ.get("EVSTIM_LOG", "INFO").upper())
    as_json = "--json" in tokens
    status.soft_wrap = not status.is_terminal
    boxed = status.is_terminal and not as_json and "--quiet" not in tokens
    if "--quiet" in tokens:
        tokens = [token for token in tokens if token != "--quiet"]
        status.quiet = True  # no progress, notices and warnings on stderr; errors and results stay
    try:
        return _exit_code(tokens, as_json, boxed)
    except CycloptsError as error:
        return _fail(Failure(str(error), WRONG_USE), as_json, printed=boxed)
    except Failure as failure:
        return _fail(failure, as_json, printed=failure.exit_code == UNREAD)
    except BaseException as error:
        # numba raises a SystemError within the call of a kernel, and a callback without its result any other error
        if not isinstance(error.__cause__ or error, KeyboardInterrupt) and not interruption.is_requested:
            raise
        return _interrupted(as_json)


def _interrupted(as_json: bool) -> int:
    """Report the interrupt of a command, and return its exit code."""
    ignore_stop_signals()
    return _fail(Failure("interrupted", BAD_VERDICT), as_json)


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
    if tokens[0] not in VERBS.built_in_names:
        _add_verbs_of_packages(tokens[0])
    shown = help_console(app)
    code = int(app(tokens, console=shown, error_console=status, exit_on_error=False, print_error=boxed) or GOOD)
    if sys.stdout is not None:
        sys.stdout.flush()
    return code


def _fail(failure: Failure, as_json: bool, printed: bool = False) -> int:
    if not printed:
        status.quiet = False
        status.print(f"evstim: {failure}", markup=False)
    if as_json and sys.stdout is not None:
        try:
            print_json({**failure.result, "error": str(failure), "exit_code": failure.exit_code})
        except Failure as unwritten:  # stdout that cannot take it changes neither the message nor the exit code
            if unwritten.exit_code != UNREAD:
                status.print(f"evstim: {unwritten}", markup=False)
    return failure.exit_code
