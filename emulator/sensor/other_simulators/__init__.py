"""Pixel methods that follow the rules of other simulators, to reproduce published results and to compare."""

from __future__ import annotations

from types import MappingProxyType

from emulator.sensor.other_simulators.counting import V2e, V2eExactFilter
from emulator.sensor.other_simulators.difference import FrameDifference
from emulator.sensor.other_simulators.pangu import Pangu
from emulator.sensor.other_simulators.rule import Rule
from emulator.sensor.other_simulators.straight import Esim, Sikorski

__all__ = ["OTHER_SIMULATORS", "Rule"]

OTHER_SIMULATORS: MappingProxyType[str, type[Rule]] = MappingProxyType(
    {
        "pangu": Pangu,
        "v2e": V2e,
        "v2e_exact_filter": V2eExactFilter,
        "sikorski": Sikorski,
        "esim": Esim,
        "frame_difference": FrameDifference,
    }
)
"""Pixel methods by their name in a rig, `run.method`."""
