"""Pixel methods that follow the rules of other simulators, to reproduce published results and to compare."""

from __future__ import annotations

from types import MappingProxyType

from emulator.sensor.methods.other_simulators import Esim, FrameDifference, Pangu, Rule, Sikorski, V2e, V2eExactFilter

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
