"""The experiments of `evstim validate`, in the order of the page. An experiment is one function, registered here."""

from __future__ import annotations

from types import MappingProxyType

from emulator.evaluation.validation.findings import Experiment
from emulator.evaluation.validation.recordings import davis346, evk4

__all__ = ["EXPERIMENTS"]

EXPERIMENTS: MappingProxyType[str, Experiment] = MappingProxyType(
    {
        "davis346_street": davis346,
        "evk4_quiet": evk4,
    }
)
"""Experiments by name."""
