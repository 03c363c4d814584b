"""Whether a process that was killed is no more."""

import time
from pathlib import Path


def gone(pid, patience_s=120.0):
    """Wait until a process has ended; one that nobody has asked about yet (a zombie) has."""
    until_s = time.monotonic() + patience_s
    while _runs(Path(f"/proc/{pid}/stat")):
        if time.monotonic() > until_s:
            return False
        time.sleep(0.02)
    return True


def _runs(stat):
    try:
        return stat.read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
