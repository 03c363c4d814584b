"""A file that a run writes beside its work: where it can be written no more, it stops, and the run goes on."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

__all__ = ["OutputFile"]


class OutputFile:
    """A file for bytes, opened at once.

    Parameters
    ----------
    what : what the file is to people, for `trouble`.
    append : whether what it holds stays.

    Raises
    ------
    OSError
        It cannot be opened.

    Attributes
    ----------
    trouble : why nothing more is written, "WHAT stopped: No space left on device (PATH)"; empty while all is well.
    """

    def __init__(self, path: Path, what: str, *, append: bool = False) -> None:
        self.path = path
        self._what = what
        self._file: BinaryIO = path.open("ab" if append else "wb")
        self.trouble = ""

    def write(self, data: bytes | memoryview, *, flush: bool = False) -> bool:
        """Write `data`; False, and nothing from then on, where that is not possible."""
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
        """Write nothing more, because of `error`."""
        self.trouble = self.trouble or f"{self._what} stopped: {error.strerror or error} ({self.path})"
        with suppress(OSError):  # what lies in the buffer cannot be written either
            self._file.close()

    def close(self) -> None:
        """Close it; what is still in memory is written first."""
        try:
            self._file.close()
        except OSError as error:
            self.stop(error)
