"""Output file of a run: when it can no longer be written, writing stops, and the run continues."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import BinaryIO


class OutputFile:
    """File for bytes, opened at once; raises OSError.

    Parameters
    ----------
    title : name of the file for people, in `trouble`.
    append : True to append to the existing contents.

    Attributes
    ----------
    trouble : reason for the stop, "TITLE stopped: No space left on device (PATH)"; empty without an error.
    """

    def __init__(self, path: Path, title: str, *, append: bool = False) -> None:
        self.path = path
        self._title = title
        self._file: BinaryIO = path.open("ab" if append else "wb")
        self.trouble = ""

    def write(self, data: bytes | memoryview, *, flush: bool = False) -> bool:
        """Write `data`; return False, and write nothing from then on, if that is not possible."""
        if self.trouble:
            return False
        try:
            self._file.write(data)
            if flush:
                self._file.flush()
        except OSError as error:
            self.stop(error)
        return not self.trouble

    def stop(self, error: OSError) -> None:
        """Stop writing, because of `error`."""
        self.trouble = self.trouble or f"{self._title} stopped: {error.strerror or error} ({self.path})"
        with suppress(OSError):  # the data in the buffer cannot be written either
            self._file.close()

    def close(self) -> None:
        """Write the data in memory, and close the file."""
        try:
            self._file.close()
        except OSError as error:
            self.stop(error)
