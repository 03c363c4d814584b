"""Text files of unknown origin: regular files of a bounded size, as UTF-8, and messages of a bounded length."""

from __future__ import annotations

from pathlib import Path

__all__ = ["TextFileError", "read_text", "shortened"]

_MOST_TOLD = 400


class TextFileError(Exception):
    """The text cannot be had; the message says why, without the file's name."""


def read_text(path: Path, most_bytes: int) -> str:
    """Return the text of a file of at most `most_bytes`; raises TextFileError."""
    try:
        if path.exists() and not path.is_file():
            raise TextFileError("cannot be read: it is no regular file")
        if (size := path.stat().st_size) > most_bytes:
            raise TextFileError(f"is {size} bytes long: at most {most_bytes} are read")
        return _decoded(path.read_bytes())
    except OSError as error:
        raise TextFileError(f"cannot be read: {error.strerror or error}") from error
    except ValueError as error:  # a name with a NUL
        raise TextFileError(f"cannot be read: {error}") from error


def _decoded(data: bytes) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise TextFileError(
            f"cannot be read: line {line}: byte 0x{data[error.start]:02x} is not UTF-8: save the file as UTF-8, "
            "or leave the letter out"
        ) from error


def shortened(error: BaseException) -> str:
    """Return an error's message for people, or its type where it has none: a damaged file may bring pages of text."""
    text = str(error) or type(error).__name__
    return text if len(text) <= _MOST_TOLD else f"{text[:_MOST_TOLD]} ..."
