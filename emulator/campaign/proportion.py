"""The share of successes and how well it is known."""

from __future__ import annotations

from dataclasses import dataclass

from scipy.stats import binomtest

__all__ = ["Proportion", "proportion"]


@dataclass(frozen=True)
class Proportion:
    """Successes among runs, with the Wilson interval of their probability."""

    successes: int
    runs: int
    low: float
    high: float

    @property
    def share(self) -> float:
        """Successes divided by runs; 0 without a run."""
        return self.successes / self.runs if self.runs else 0.0

    def __str__(self) -> str:
        return f"{self.successes} of {self.runs} ({self.share:.1%}; 95 % interval {self.low:.1%} to {self.high:.1%})"


def proportion(successes: int, runs: int, confidence: float = 0.95) -> Proportion:
    """Return the share of successes with its Wilson interval."""
    if not runs:
        return Proportion(0, 0, 0.0, 1.0)
    interval = binomtest(successes, runs).proportion_ci(confidence, method="wilson")
    return Proportion(successes, runs, float(interval.low), float(interval.high))
