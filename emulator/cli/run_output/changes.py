"""Summary lines about what changed a run from outside."""

from __future__ import annotations

from emulator.run.outcome import RunResult

__all__ = ["changes_lines"]

_MOST = 20


def changes_lines(result: RunResult) -> list[str]:
    """Return nothing for a run that follows from its rig and seed alone, else who changed what, and when."""
    count = len(result.changes) + result.changes_beyond
    if not count:
        return []
    lines = [f"changed from outside {count} times; the rig and its seed alone do not repeat this run:"]
    lines += [f"  {change.told}" for change in result.changes[:_MOST]]
    return lines if count <= _MOST else [*lines, f"  and {count - _MOST} more: --json and --report list them"]
