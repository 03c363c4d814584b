"""Consoles, JSON output and exit codes, the same for every command: lines break at a terminal, not in files and pipes.

A write that standard output cannot take is a failure of the command, with its exit code:

    print, rich, json -> TextIOWrapper -> BufferedWriter -> ResultFile -> descriptor 1

A full disk or a closed pipe appears at some flush, in code that has no handler for it. `ResultFile` raises Failure
there, once; the rest of the output is then discarded, so that neither the message nor the interpreter's last flush
fails again. A pipe without a reader, as after `| head`, ends the command without a message.
"""

from __future__ import annotations

import dataclasses
import io
import json
import logging
import os
import signal
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, cast

from cyclopts import Parameter
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer
    from cyclopts import App


GOOD, BAD_VERDICT, WRONG_USE, LACKING = range(4)
UNREAD = 128 + signal.SIGPIPE
"""Exit code where the output has no reader, as shells show it for a program that ends by SIGPIPE."""

Flag = Annotated[bool, Parameter(negative="")]
"""An option without a value, and without a `--no-` form."""
Json = Annotated[bool, Parameter(negative="", help="Print one JSON object as the last line on stdout.")]
"""The option `--json` of a verb."""
RigName = Annotated[str, Parameter(help="Path of a rig file, or the name of a shipped one (see `evstim rigs`).")]
"""The rig of a verb."""
SensorSize = Annotated[
    str | None, Parameter(help="WIDTHxHEIGHT of the sensor, such as 346x260, for files that do not contain it.")
]
"""The option `--size` of a verb that reads a recording."""

Topic = Annotated[str | None, Parameter(help="Topic of the events, of a ROS bag with those of several cameras.")]
"""The option `--topic` of a verb that reads a recording."""

ESCAPES = {code: repr(chr(code))[1:-1] for code in (*range(32), *range(127, 160), *range(0xDC80, 0xDD00))}
"""Texts of control characters, and of bytes of a name that are no UTF-8, for `str.translate`: a terminal obeys them."""


class _SafeConsole(Console):
    """Console that shows control characters of names, titles and peers' messages as escapes."""

    _escapes = ESCAPES | {ord(blank): blank for blank in "\t\n"}

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Yield the parts of a renderable; those that move the cursor stay as they are."""
        for part in super().render(renderable, options):
            yield part if part.control else Segment(part.text.translate(self._escapes), part.style)


console = _SafeConsole(highlight=False, soft_wrap=True)
"""Results, on stdout."""

status = _SafeConsole(stderr=True, highlight=False)
"""Progress and errors, on stderr."""


class Failure(Exception):
    """A command cannot do its work; carries the exit code, and for `--json` what it did before."""

    def __init__(self, message: str, exit_code: int, result: Mapping[str, object] = MappingProxyType({})) -> None:
        super().__init__(message)
        self.exit_code = exit_code
        self.result = result


_SINGULAR = {"are": "is", "remain": "remains"}


def counted(count: int, noun: str, verb: str = "") -> str:
    """Return a number with its noun, and the verb of its plural: "1 run is", "2 runs are"."""
    words = (noun, _SINGULAR.get(verb, verb)) if count == 1 else (f"{noun}s", verb)
    return " ".join([str(count), *words]).rstrip()


def parsed_address(option: str, text: str, least_port: int = 1) -> tuple[str, int]:
    """Return (host, port) of text such as "127.0.0.1:10015"; raises Failure."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not least_port <= int(port) <= 65535:
        raise Failure(f"{option}: {text!r} is not HOST:PORT, such as 127.0.0.1:10015", WRONG_USE)
    return host.strip("[]"), int(port)


@contextmanager
def failing(exit_code: int, *errors: type[Exception], at: str = "") -> Iterator[None]:
    """Turn errors into Failure; with `at`, an option or a file, it is named before the reason."""
    try:
        yield
    except errors as error:
        reason = getattr(error, "strerror", None) or error
        raise Failure(f"{at}: {reason}" if at else str(error), exit_code) from error


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the rows of a table as lines."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def print_json(value: object) -> None:
    """Print one line of JSON on stdout; raises Failure where that was closed before the start."""
    if sys.stdout is None:
        raise Failure("--json: stdout is closed: the result was not written", LACKING)
    sys.stdout.write(json.dumps(value, default=_plain) + "\n")
    sys.stdout.flush()


def print_result(as_json: bool, value: object, lines: Iterable[str]) -> None:
    """Print the result of a command: `value` as one line of JSON for programs, or the lines for people."""
    if as_json:
        print_json(value)
        return
    for line in lines:
        console.print(line, markup=False)


def _plain(value: object) -> object:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"cannot write {type(value).__name__} as JSON")


_UNBROKEN = 100_000  # columns


class _WholeLines(logging.Handler):
    """Handler that prints each record of the log as one line on `status`."""

    def emit(self, record: logging.LogRecord) -> None:
        status.print(self.format(record), markup=False)


def log_handler() -> logging.Handler:
    """Return the handler that prints the log on `status`."""
    if status.is_terminal:
        from rich.logging import RichHandler  # a tenth of the command line's imports

        return RichHandler(console=status, show_path=False, show_time=False)
    handler = _WholeLines()
    handler.setFormatter(logging.Formatter("%(levelname)-8s %(message)s"))
    return handler


def help_console(app: App) -> Console | None:
    """Set the format of the help of `app`, and return its console; None for its own."""
    if console.is_terminal:
        app.help_formatter = "default"
        return None
    app.help_formatter = "plain"  # no boxes
    return Console(width=_UNBROKEN)


class ResultFile(io.FileIO):
    """Raw file that writes to a descriptor and raises Failure when the descriptor takes no more."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor, "w", closefd=False)
        self._has_failed = False

    def write(self, data: ReadableBuffer) -> int:
        """Write the bytes that the descriptor takes, and return their number; raises Failure once, then discards."""
        if self._has_failed:
            return memoryview(data).nbytes
        try:
            return os.write(self.fileno(), data)
        except OSError as error:
            self._has_failed = True
            code = UNREAD if isinstance(error, BrokenPipeError) else LACKING
            raise Failure(f"stdout: {error.strerror}: the result was not written in full", code) from error


def guard_stdout() -> None:
    """Let `sys.stdout` raise Failure when it takes no more; one that was closed before the start stays None."""
    if sys.stdout is None:
        return
    plain = cast(io.TextIOWrapper, sys.stdout)
    sys.stdout = io.TextIOWrapper(
        io.BufferedWriter(ResultFile(plain.fileno())),
        encoding=plain.encoding,
        errors=plain.errors,
        line_buffering=plain.line_buffering,
    )
