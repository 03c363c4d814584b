"""Priority of a process that must not wait for the session that feeds it, nor for other programs.

Linux divides processors by session first (autogroup), and by nice value within a session. A process that sleeps most of
the time, in a session of its own, runs as soon as it is ready, whatever the others do. Both values need a permission
(root, or 'nice' in /etc/security/limits.conf); a session of its own needs none.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

MOST_NICE = -20
"""Nice value of a process that answers within milliseconds."""

LINK_NICE = -10
"""Nice value of a link's process."""

_AUTOGROUP = Path("/proc/self/autogroup")


def run_before_others(nice: int) -> None:
    """Set a nice value and that of the session, as far as permitted; a process that leads none gets one of its own."""
    with suppress(PermissionError):  # it leads a group of processes, and so has its session
        os.setsid()
    with suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, nice)
        with suppress(OSError):  # a kernel that divides processors by process has no such file
            _AUTOGROUP.write_text(str(nice))
