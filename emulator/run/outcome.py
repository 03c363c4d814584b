"""What a run has done: so far, for those who watch it, and in the end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from emulator.run.changes import Change
from emulator.run.lateness import Lateness
from emulator.run.ledger import Ledger
from transports.link.report import LinkReport

__all__ = ["RunResult", "RunStatus"]


@dataclass(frozen=True)
class RunStatus:
    """What a run has done so far, for the live table."""

    sim_seconds: float
    wall_seconds: float
    frames: int
    read_out: int
    lateness: Lateness
    links: dict[str, LinkReport]
    raised: int = 0
    lost_in_pixel: int = 0
    lost_at_readout: int = 0


@dataclass(frozen=True)
class RunResult:
    """What a run has done.

    Attributes
    ----------
    changes, changes_beyond
        What changed it from outside, and how many changes more there were.
    """

    sim_seconds: float
    wall_seconds: float
    frames: int
    steps: int
    ledger: Ledger
    lateness: Lateness
    links: dict[str, LinkReport] = field(default_factory=dict)
    undersampled_share: float | None = None
    scene_counts: Mapping[str, int] = field(default_factory=dict)
    syncs: int | None = None
    painter: Literal["cpu", "gl"] = "cpu"
    renderer: str | None = None
    pixels_by: str | None = None
    max_late_us: float = 0.0
    max_late_share: float = 1.0
    changes: tuple[Change, ...] = ()
    changes_beyond: int = 0

    @property
    def late_share(self) -> float:
        """Share of the steps that were ready after they were due."""
        return self.lateness.frames_late / self.steps if self.steps else 0.0

    @property
    def step_too_late(self) -> bool:
        """True when a step was later than the schedule allows."""
        return 0 < self.max_late_us < self.lateness.worst_gap_us

    @property
    def late_too_often(self) -> bool:
        """True when more steps were late than the schedule allows."""
        return self.max_late_us > 0 and self.late_share > self.max_late_share

    @property
    def drawn_by(self) -> str:
        """The painter in words, with GL's name of its renderer."""
        return f"GL: {self.renderer}" if self.painter == "gl" else self.renderer or "the CPU"

    @property
    def too_late(self) -> bool:
        """True when the run has not kept up with real time, by either limit."""
        return self.step_too_late or self.late_too_often

    @property
    def good(self) -> bool:
        """True when all events, edges and readings have one fate, no link failed, files are whole, the run kept up."""
        links = self.links.values()
        sound = self.ledger.balanced and all(
            link.error is None and link.edges_balanced and link.readings_balanced for link in links
        )
        sound = sound and not any(link.file_troubles for link in links)
        return sound and not self.too_late
