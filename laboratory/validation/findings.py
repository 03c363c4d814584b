"""Values measured on a real camera beside ours, with the distance between them.

An experiment is a function that repeats one public measurement and returns `Findings`. Each value is a `Datum`, which
has a bound: the distance within which we call it alike. There are four kinds of distance:

    relative     |ours / real - 1|
    factor       the larger of ours / real and real / ours
    difference   |ours - real|, in the datum's unit
    statistic    ours, a distance between two samples by itself, such as Kolmogorov and Smirnov's; `real` is the same
                 distance between two halves of the real recording
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

Kind = Literal["relative", "factor", "difference", "statistic"]

Draw = Callable[[Path], list[Path]]
"""Draws the picture of an experiment at a path without its suffix; returns the files, SVG first."""


@dataclass(frozen=True, slots=True)
class Datum:
    """A value of a real camera beside ours.

    Attributes
    ----------
    what : str
        The condition, such as "ON at 0.046 W/m2, factory biases".
    real, ours : float
        The two values, in `unit`; NaN where there is none.
    unit : str
        Unit; "" for a number.
    kind : Kind
        Distance between the two.
    bound : float
        Largest distance that is alike; NaN: shown, not judged, and `remark` gives the reason.
    remark : str
        Doubts about the measurement or the comparison.
    """

    what: str
    real: float
    ours: float
    unit: str
    kind: Kind
    bound: float
    remark: str = ""

    def __post_init__(self) -> None:
        if math.isnan(self.bound) and not self.remark:
            raise ValueError(f"{self.what}: a datum without a bound needs a remark that gives the reason")

    @property
    def distance(self) -> float:
        """Distance of ours from the real value, by `kind`; infinite where a ratio has no value."""
        if self.kind == "statistic":
            return self.ours
        if self.kind == "difference":
            return abs(self.ours - self.real)
        if not (self.real > 0 and self.ours > 0):
            return math.inf
        if self.kind == "relative":
            return abs(self.ours / self.real - 1)
        return max(self.ours / self.real, self.real / self.ours)

    @property
    def judged(self) -> bool:
        """True: the datum has a bound."""
        return not math.isnan(self.bound)

    @property
    def alike(self) -> bool:
        """True: within the bound. A distance that is NaN is not alike."""
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
    title, address : str
        Citation; DOI or address.
    licence : str
        Licence, with the acknowledgement that it requires.
    obtained : str
        The way the values were obtained, such as "digitised from the maps of the repository".
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
    name : str
        One word, also the stem of its files.
    title : str
        Heading on the page.
    sensor : str
        Preset that is measured.
    protocol : str
        The experiment, and our repetition, in a few sentences.
    sources : tuple of Source
        Origin of the real values.
    data : tuple of Datum
        All values.
    remarks : tuple of str
        Limits of the comparison, and what could not be obtained.
    draw : Draw or None
        Picture of the experiment.
    """

    name: str
    title: str
    sensor: str
    protocol: str
    sources: tuple[Source, ...]
    data: tuple[Datum, ...]
    remarks: tuple[str, ...] = ()
    draw: Draw | None = field(default=None, compare=False)

    @property
    def judged(self) -> tuple[Datum, ...]:
        """The data that have a bound."""
        return tuple(datum for datum in self.data if datum.judged)


Experiment = Callable[[int], Findings]
"""Repeats a measurement with a seed."""
