"""The rules of other simulators, as pixel methods beside our own: to reproduce what they published, and to compare."""

from __future__ import annotations

from types import MappingProxyType

from emulator.sensor.other_simulators.counting import Held, V2e
from emulator.sensor.other_simulators.difference import FrameDifference
from emulator.sensor.other_simulators.pangu import Pangu
from emulator.sensor.other_simulators.rule import Rule
from emulator.sensor.other_simulators.straight import Esim, Sikorski

__all__ = ["RULES", "Rule"]

RULES: MappingProxyType[str, type[Rule]] = MappingProxyType(
    {
        "pangu": Pangu,
        "v2e": V2e,
        "held": Held,
        "sikorski": Sikorski,
        "esim": Esim,
        "frame_difference": FrameDifference,
    }
)
"""Rules by the name that a rig gives as `method`."""
