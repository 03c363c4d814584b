"""What every verb shares: how it prints, and how it fails."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from emulator.link_process import LinkFailed
from emulator.rig import RigError
from emulator.scene.base import MachineLacks, SceneError

__all__ = ["BAD_VERDICT", "GOOD", "LACKING", "WRONG_USE", "Failure", "console", "failures", "print_json", "status"]

GOOD, BAD_VERDICT, WRONG_USE, LACKING = range(4)

console = Console(highlight=False, soft_wrap=True)
"""Results, on stdout."""

status = Console(stderr=True, highlight=False)
"""Progress and complaints, on stderr."""


class Failure(Exception):
    """A verb cannot do what it was asked; carries the exit code."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code


@contextmanager
def failures() -> Iterator[None]:
    """Turn the errors of all rooms into Failure with its exit code."""
    try:
        yield
    except (MachineLacks, LinkFailed) as error:
        raise Failure(str(error), LACKING) from error
    except (RigError, SceneError) as error:
        raise Failure(str(error), WRONG_USE) from error


def print_json(value: object) -> None:
    """Print one line of JSON on stdout."""
    sys.stdout.write(json.dumps(value, default=_plain) + "\n")
    sys.stdout.flush()


def _plain(value: object) -> object:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"cannot write {type(value).__name__} as JSON")
