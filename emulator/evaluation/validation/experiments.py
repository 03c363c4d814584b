"""The experiments of `evstim validate`, in the order of the page. An experiment is one function, registered here."""

from __future__ import annotations

from types import MappingProxyType

from emulator.evaluation.validation.background import background
from emulator.evaluation.validation.findings import Experiment

__all__ = ["EXPERIMENTS"]

EXPERIMENTS: MappingProxyType[str, Experiment] = MappingProxyType({"background": background})
"""Experiments by name."""
