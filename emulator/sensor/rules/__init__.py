"""The rules of other simulators, as pixel methods beside our own: to reproduce what they published, and to compare."""

from __future__ import annotations

from types import MappingProxyType

from emulator.sensor.rules.counting import Held, V2e
from emulator.sensor.rules.difference import FrameDifference
from emulator.sensor.rules.pangu import Pangu
from emulator.sensor.rules.rule import Rule
from emulator.sensor.rules.straight import Esim, Sikorski

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
