"""Values measured on a real camera beside ours, with the distance between them.

An experiment is a function that repeats one public measurement with a seed and returns `Findings`. Each value is a
`Datum`, which has a bound: the distance within which we call it alike. There are four kinds of distance:

    relative     |ours / real - 1|
    factor       the larger of ours / real and real / ours
    difference   |ours - real|, in the datum's unit
    statistic    ours, a distance between two samples by itself, such as Kolmogorov and Smirnov's; `real` is the same
                 distance between two halves of the real recording
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

Kind = Literal["relative", "factor", "difference", "statistic"]

Draw = Callable[[Path], list[Path]]
"""Draws the picture of an experiment at a path without its suffix; returns the files, SVG first."""


@dataclass(frozen=True, slots=True)
class Datum:
    """A value of a real camera beside ours.

    Attributes
    ----------
    what : the condition, such as "ON at 0.046 W/m2, factory biases".
    real, ours : the values, in `unit`; ours is the median over the seeds, NaN where the simulated sensor gives none.
    unit : "" for a number.
    kind : distance between the two.
    bound : largest distance that is alike.
    fitted : True: a preset value was chosen by this datum, which shows what the model can follow; False: predicted.
    apart : the distance, of the same kind, between two real ones, such as two regions of a chip; NaN: not known.
    remark : doubts about the measurement or the comparison.
    seeds : ours for each seed; empty: one seed.
    """

    what: str
    real: float
    ours: float
    unit: str
    kind: Kind
    bound: float
    fitted: bool
    apart: float = math.nan
    remark: str = ""
    seeds: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if math.isnan(self.real) or math.isnan(self.bound):
            raise ValueError(f"{self.what}: real = {self.real}, bound = {self.bound}: a datum needs both")

    @property
    def distances(self) -> tuple[float, ...]:
        """Distance from the real value for each seed."""
        return tuple(self.distance_of(ours) for ours in self.seeds or (self.ours,))

    def distance_of(self, ours: float) -> float:
        """Return the distance of a value from the real one, by `kind`; infinite where a ratio has no value."""
        ratio = self.kind in ("relative", "factor")
        if math.isnan(ours) or (ratio and not (self.real > 0 and ours > 0)):
            return math.inf
        if self.kind == "statistic":
            return ours
        if self.kind == "difference":
            return abs(ours - self.real)
        return abs(ours / self.real - 1) if self.kind == "relative" else max(ours / self.real, self.real / ours)

    @property
    def distance(self) -> float:
        """Largest distance over the seeds."""
        return max(self.distances)

    @property
    def alike(self) -> bool:
        """True: within the bound for every seed."""
        return self.distance <= self.bound

    @property
    def excess(self) -> float:
        """Distance in units of the bound, by which disagreement is ordered; of a factor, that of its logarithms."""
        if self.kind == "factor":
            return math.log(self.distance) / math.log(self.bound)
        return self.distance / self.bound if self.bound else math.inf


@dataclass(frozen=True, slots=True)
class Source:
    """The origin of measured values.

    Attributes
    ----------
    title, address : citation; DOI or address.
    licence : its name, with the acknowledgement that it requires.
    obtained : the way the values were obtained, such as "digitised from the maps of the repository".
    """

    title: str
    address: str
    licence: str
    obtained: str


@dataclass(frozen=True, slots=True)
class Findings:
    """One public measurement, repeated.

    Attributes
    ----------
    name : one word, also the stem of its files.
    title : heading on the page.
    sensor : preset that is measured.
    protocol : the experiment, and our repetition, in a few sentences.
    sources : origin of the real values.
    data : all values.
    remarks : limits of the comparison, and what could not be obtained.
    draw : picture of the experiment.
    """

    name: str
    title: str
    sensor: str
    protocol: str
    sources: tuple[Source, ...]
    data: tuple[Datum, ...]
    remarks: tuple[str, ...] = ()
    draw: Draw | None = field(default=None, compare=False)

    def rows(self, fitted: bool) -> tuple[Datum, ...]:
        """Return the data that are fitted, or those that are predicted."""
        return tuple(datum for datum in self.data if datum.fitted == fitted)


def over_seeds(found: Sequence[Findings]) -> Findings:
    """Return the findings of one experiment with several seeds as one; pictures and remarks are those of the first."""
    data = tuple(
        dataclasses.replace(same[0], ours=float(np.median(ours := tuple(d.ours for d in same))), seeds=ours)
        for same in zip(*(one.data for one in found), strict=True)
    )
    return dataclasses.replace(found[0], data=data)


Experiment = Callable[[int], Findings]
"""Repeats a measurement with a seed."""
