"""Checks of recordings that commands read and write, and their errors as failures of a command."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from emulator.cli.output import LACKING, WRONG_USE, Failure
from emulator.cli.output_paths import check_output
from transports.recording.format import Format, format_to_write
from transports.recording.guarded import LibraryMissing
from transports.recording.part import RecordingError
from transports.recording.reasons import reason

__all__ = ["check_recording", "parsed_size", "reading", "writing"]


def check_recording(option: str, path: Path, name: str = "") -> Format:
    """Return the format that `path` will be written in; raises Failure where it cannot be."""
    try:
        form = format_to_write(path, name)
        form.imported(form.writer)
    except RecordingError as error:
        lacks = "pip install" in str(error)
        raise Failure(f"{option}: {error}", LACKING if lacks else WRONG_USE) from error
    if form.is_folder:
        if path.exists():
            raise Failure(f"{option}: {path} exists; a {form.title} is a folder of its own", WRONG_USE)
        if not path.parent.is_dir():
            raise Failure(f"{option}: the folder {path.parent} does not exist", WRONG_USE)
    else:
        check_output(option, path)
    return form


def parsed_size(text: str | None) -> tuple[int, int] | None:
    """Return (width, height) of text such as "346x260"; raises Failure."""
    if text is None:
        return None
    told = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if told is None or not int(told[1]) or not int(told[2]):
        raise Failure(f"--size must be WIDTHxHEIGHT such as 346x260, got {text!r}", WRONG_USE)
    return int(told[1]), int(told[2])


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what is wrong with a recording that is read into Failure."""
    try:
        yield
    except LibraryMissing as error:
        raise Failure(f"{path}: {error}", LACKING) from error
    except RecordingError as error:
        raise Failure(f"{path}: {error}", WRONG_USE) from error
    except OSError as error:
        raise Failure(f"{path}: {error.strerror or error}", WRONG_USE) from error


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn what goes wrong while a recording is written into Failure; libraries raise what they like."""
    try:
        yield
    except (Failure, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise Failure(f"{path}: {reason(error)}", LACKING if isinstance(error, OSError) else WRONG_USE) from error
