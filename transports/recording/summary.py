"""Summary of a closed recording: its contents, and the omitted data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

__all__ = ["RecordingSummary", "named"]

_NAMES = {"events": "events", "edges": "triggers", "imu": "IMU samples", "frames": "frames"}


@dataclass(frozen=True)
class RecordingSummary:
    """Summary of a file that a run wrote.

    Attributes
    ----------
    title
        Its format, for people.
    paths
        The file, and those that began at restarts of the camera's clock.
    written, left_out
        Number of records of each stream in it, and of those that its format cannot hold: "events", "edges", "imu",
        "frames". Both are empty until it is closed.
    trouble
        Reason for an incomplete file, for people; empty if it is complete.
    closed
        True if it was finished; False if the process of its link died.
    """

    title: str
    paths: tuple[str, ...]
    written: Mapping[str, int] = field(default_factory=dict)
    left_out: Mapping[str, int] = field(default_factory=dict)
    trouble: str = ""
    closed: bool = False

    @property
    def lines(self) -> list[str]:
        """Sentences for people."""
        content = (named(self.written) or "nothing") if self.closed else "not closed, as its link died"
        lines = [f"{', '.join(self.paths)}: {self.title}, {content}"]
        if self.left_out:
            lines.append(f"left out, as {self.title} cannot hold them: {named(self.left_out)}")
        return lines


def named(counts: Mapping[str, int]) -> str:
    """Return "3 events, 2 triggers" of counts by stream."""
    return ", ".join(f"{counts[name]} {text}" for name, text in _NAMES.items() if counts.get(name))
