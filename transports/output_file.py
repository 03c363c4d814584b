"""Output file of a run: when it can no longer be written, writing stops, and the run continues. Temporary folders.

A temporary folder has a mark, a file that its process holds locked as long as it lives, in whatever container. When the
next folder is made, folders whose mark is not locked are removed: their process was killed.
"""

from __future__ import annotations

import atexit
import fcntl
import os
import shutil
import stat
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

_MARK = ".evstim-temporary"


class TemporaryFolder(tempfile.TemporaryDirectory[str]):
    """New folder evstim-NAME-XXXXXXXX, by default in TMPDIR, that is removed at its end, or after a kill by the next.

    Raises OSError.
    """

    def __init__(self, name: str, parent: Path | None = None) -> None:
        _remove_leftovers(parent or Path(tempfile.gettempdir()))
        super().__init__(prefix=f"evstim-{name}-", dir=parent, ignore_cleanup_errors=True)
        self._mark = _marked(Path(self.name))

    def cleanup(self) -> None:
        """Remove the folder; a second call does nothing."""
        super().cleanup()
        self._mark.close()


def lasting_folder(name: str) -> Path:
    """Return a new folder evstim-NAME-XXXXXXXX in TMPDIR that stays, unless it is empty or this process is killed.

    Raises OSError.
    """
    _remove_leftovers(Path(tempfile.gettempdir()))
    folder = Path(tempfile.mkdtemp(prefix=f"evstim-{name}-"))
    mark = _marked(folder)

    def release() -> None:
        with suppress(OSError), mark:
            (folder / _MARK).unlink()
            folder.rmdir()

    atexit.register(release)
    return folder


def _marked(folder: Path) -> BinaryIO:
    """Return the mark of a new folder, locked while it is open; it takes its name when it is locked."""
    file = (folder / f"{_MARK}.new").open("xb")
    file.write(folder.name.encode())  # a copy of the folder is the user's
    file.flush()
    with suppress(OSError):  # a file system without locks: the folder stays after a kill
        fcntl.flock(file, fcntl.LOCK_EX)
        Path(file.name).rename(folder / _MARK)
    return file


def _remove_leftovers(parent: Path) -> None:
    """Remove this user's marked folders in `parent` whose mark is not locked."""
    for path in parent.glob(f"evstim-*/{_MARK}"):
        folder = path.parent
        with suppress(OSError), open(os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as mark:
            status = folder.lstat()
            is_ours = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() == os.fstat(mark.fileno()).st_uid
            if is_ours and mark.read(256) == folder.name.encode():
                fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises BlockingIOError while its process lives
                shutil.rmtree(folder, ignore_errors=True)


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
