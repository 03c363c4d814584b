"""The experiments of `evstim validate`, in the order of the page. An experiment is one function, registered here."""

from __future__ import annotations

from types import MappingProxyType

from emulator.evaluation.validation.background import background
from emulator.evaluation.validation.findings import Experiment
from emulator.evaluation.validation.latency import latency, opposite, region, spread
from emulator.evaluation.validation.recordings import davis346, evk4
from emulator.evaluation.validation.stars import stars

__all__ = ["EXPERIMENTS"]

EXPERIMENTS: MappingProxyType[str, Experiment] = MappingProxyType(
    {
        "latency": latency,
        "region": region,
        "spread": spread,
        "opposite": opposite,
        "davis346_street": davis346,
        "evk4_quiet": evk4,
        "background": background,
        "stars": stars,
    }
)
"""Experiments by name."""
