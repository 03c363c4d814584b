"""Consoles, JSON output and exit codes, the same for every command."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

from rich.console import Console

__all__ = ["BAD_VERDICT", "GOOD", "LACKING", "WRONG_USE", "Failure", "console", "print_json", "status"]


GOOD, BAD_VERDICT, WRONG_USE, LACKING = range(4)

console = Console(highlight=False, soft_wrap=True)
"""Results, on stdout."""

status = Console(stderr=True, highlight=False)
"""Progress and errors, on stderr."""


class Failure(Exception):
    """A command cannot do its work; carries the exit code."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code


def print_json(value: object) -> None:
    """Print one line of JSON on stdout; raises Failure where that was closed before the start."""
    if sys.stdout is None:
        raise Failure("--json: stdout is closed: the result was not written", LACKING)
    sys.stdout.write(json.dumps(value, default=_plain) + "\n")
    sys.stdout.flush()


def _plain(value: object) -> object:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"cannot write {type(value).__name__} as JSON")
