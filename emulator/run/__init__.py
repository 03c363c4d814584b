"""A run of a rig: assembly, session, pacing, ledger, triggers and control."""

from __future__ import annotations

import os
import sys

_STDERR = 2


def fill_standard_descriptors() -> None:
    """Open /dev/null for each of the descriptors 0 to 2 that is closed, in child processes too; before any file.

    A process that is started with `2>&-` has no descriptor 2. The next file that it opens gets this number, such as the
    shared memory of a ring, and text for standard error is then written into that file, also by the processes of links.
    `sys.stdout` stays None where descriptor 1 was closed, so that a result for programs is not lost silently.
    """
    closed = [descriptor for descriptor in range(_STDERR + 1) if _is_closed(descriptor)]
    for _ in closed:  # in ascending order: a new file gets the lowest number that is free
        os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    if sys.stderr is None:
        sys.stderr = open(_STDERR, "w", encoding="utf-8", closefd=False)  # noqa: SIM115 - it stays open as long as the process


def _is_closed(descriptor: int) -> bool:
    try:
        os.fstat(descriptor)
    except OSError:
        return True
    return False
