"""A folder that is made once and kept: one process makes it, others that want it wait."""

import fcntl
import tempfile
from pathlib import Path

__all__ = ["made_once"]


def made_once(folder, make):
    """Return `folder`, which `make` fills under another name first, so that what is there is whole."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with (folder.parent / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.is_dir():
            with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
                made = Path(scratch) / folder.name
                make(made)
                made.rename(folder)
    return folder
