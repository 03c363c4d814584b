"""Check of the files that a command will write, made before it begins its work."""

from __future__ import annotations

import os
from pathlib import Path

from emulator.cli.output import WRONG_USE, Failure

__all__ = ["check_output"]


def check_output(option: str, path: Path | None, suffix: str = "") -> None:
    """Raise Failure where a file cannot be written, or does not end in the one `suffix` that is; None is no file."""
    if path is None:
        return
    if suffix and path.suffix != suffix:
        raise Failure(f"{option}: {path} must end in {suffix}, the one format that is written", WRONG_USE)
    if not path.parent.is_dir():
        raise Failure(f"{option}: the folder {path.parent} does not exist", WRONG_USE)
    try:
        if path.is_dir():
            raise Failure(f"{option}: {path} is a folder; name a file", WRONG_USE)
        _open_once(path)
    except OSError as error:
        raise Failure(f"{option}: {path}: {error.strerror}", WRONG_USE) from error


def _open_once(path: Path) -> None:
    """Open a file for writing and leave what it holds; raises OSError.

    A file that is not there does not appear under its name, not even for an instant: somebody may wait for it.
    """
    is_new = not path.exists()
    tried = path.with_name(f".{path.name}.{os.getpid()}") if is_new else path
    os.close(os.open(tried, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NONBLOCK, 0o666))  # a pipe must not wait
    if is_new:
        tried.unlink()
