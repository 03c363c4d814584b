"""The tables of a campaign file, as frozen types."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from emulator.campaign.laws import Law
from emulator.campaign.sampling import Sampling
from emulator.campaign.success import SuccessRule

__all__ = ["Plots", "Program", "Settings"]


@dataclass(frozen=True)
class Program:
    """The program under test, started once for each run.

    Attributes
    ----------
    argv
        Program and arguments. Placeholders: {index}, {seed}, {folder} (the run's own, for its files), {result} (the
        JSON file that it may write), {record} (what the links delivered), {python}, {address} (of the only link),
        {address.NAME}, {port}, {port.NAME}, and {KEY} for the value of a parameter.
    start
        "with": when the links of the run are open; "after": when the run is over.
    ends_run
        Whether the run ends when the program does; only a program that starts with the run can.
    grace_s
        How long the program may take to end after the run has; then it is stopped. Started after the run: how long it
        may take at all.
    """

    argv: tuple[str, ...]
    start: Literal["with", "after"] = "with"
    ends_run: bool = False
    grace_s: float = 10.0

    def __post_init__(self) -> None:
        if not self.argv:
            raise ValueError("argv must name a program")
        if self.ends_run and self.start == "after":
            raise ValueError('ends_run is for start = "with": a program that starts after the run cannot end it')
        if not 0 <= self.grace_s <= 1e6:
            raise ValueError(f"grace_s must be 0 to 1e6, got {self.grace_s}")


@dataclass(frozen=True)
class Plots:
    """What the report shows.

    Attributes
    ----------
    columns
        Columns of which the sensitivity is told; by default success, the margin, the event rate and the numbers that
        the program gives.
    worst
        The column that orders the worst runs; by default the margin.
    worst_is
        Whether the lowest or the highest values of it are the worst.
    labels
        What the report calls columns and parameters, with their units: "result.vertical_m_s" = "touchdown, m/s".
    """

    columns: tuple[str, ...] = ()
    worst: str = "margin"
    worst_is: Literal["lowest", "highest"] = "lowest"
    labels: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Settings:
    """A campaign file but its rig.

    Attributes
    ----------
    rig
        Name of a shipped rig, or path of a rig file, absolute or from the campaign's folder.
    title
        What the campaign is for, in one sentence.
    sampling
        How the values of the parameters are chosen.
    count
        Number of points; with "saltelli" of base points; a grid has as many as it has.
    repeats
        Runs of each point, each with a seed of its own.
    seed
        Changes all that is random in the campaign.
    success
        What a run must keep to be a success: "verdict", "program" (it ends with 0), and rules "COLUMN OP VALUE".
    min_success
        Share of successes below which `evstim campaign` ends with 1.
    timeout_s
        Time after which a run is given up.
    record
        Suffix of a recording that each run keeps of what its links delivered, such as ".npz"; none by default.
    parameters
        What is sampled.
    program
        The program under test.
    report
        What the report shows.
    set
        Tables of a rig, laid over the rig's own.
    """

    rig: str
    title: str = ""
    sampling: Sampling = "sobol"
    count: int = 0
    repeats: int = 1
    seed: int = 1
    success: tuple[SuccessRule, ...] = ()
    min_success: float = 0.0
    timeout_s: float = 3600.0
    record: str = ""
    parameters: tuple[Law, ...] = ()
    program: Program | None = None
    report: Plots = field(default_factory=Plots)
    set: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.sampling == "grid" and self.count:
            raise ValueError("count is for samples: a grid has as many points as its values; see repeats")
        if self.sampling != "grid" and not 1 <= self.count <= 10_000_000:
            raise ValueError(f"count must be 1 to 10000000, got {self.count}")
        if not 1 <= self.repeats <= 1_000_000:
            raise ValueError(f"repeats must be 1 to 1000000, got {self.repeats}")
        if not 0 <= self.min_success <= 1:
            raise ValueError(f"min_success must be 0 to 1, got {self.min_success}")
        if not 0 < self.timeout_s <= 1e7:
            raise ValueError(f"timeout_s must be above 0 and at most 1e7, got {self.timeout_s}")
        if self.record and not self.record.startswith("."):
            raise ValueError(f'record must be a suffix such as ".npz", got {self.record!r}')
