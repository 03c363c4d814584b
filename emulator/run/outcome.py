"""What a run has done: so far, for those who watch it, and in the end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

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
    renderer: str | None = None
    pixels_by: str | None = None
    max_late_us: float = 0.0
    changes: tuple[Change, ...] = ()
    changes_beyond: int = 0

    @property
    def too_late(self) -> bool:
        """True when a step was later than the schedule allows."""
        return 0 < self.max_late_us < self.lateness.worst_gap_us

    @property
    def good(self) -> bool:
        """True when all events, edges and readings have one fate, no link failed, files are whole, the run kept up."""
        links = self.links.values()
        sound = self.ledger.balanced and all(
            link.error is None and link.edges_balanced and link.readings_balanced for link in links
        )
        sound = sound and not any(link.file_troubles for link in links)
        return sound and not self.too_late
