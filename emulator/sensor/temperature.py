"""What the chip's temperature does to a sensor's figures: leak and dark current double every so many kelvin."""

from __future__ import annotations

import dataclasses

from emulator.sensor.presets import SensorParameters

__all__ = ["at_temperature"]


def at_temperature(p: SensorParameters) -> SensorParameters:
    """Return the figures as they are at `temperature.celsius`, given what they are at the reference temperature.

    Hot pixels leak through a junction too, so their rate follows the leak's.
    """
    t = p.temperature
    warmer_k = t.celsius - t.reference_celsius
    leak = 2 ** (warmer_k / t.leak_doubles_every_k)
    return dataclasses.replace(
        p,
        leak_hz=p.leak_hz * leak,
        defects=dataclasses.replace(p.defects, hot_hz=p.defects.hot_hz * leak),
        dark_current_relative=p.dark_current_relative * 2 ** (warmer_k / t.dark_doubles_every_k),
        temperature=dataclasses.replace(t, reference_celsius=t.celsius),
    )
