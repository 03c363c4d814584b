"""A sensor of one row, as the tables of the numerics have it."""

import dataclasses

from emulator.sensor.presets import SensorParameters

PLAIN = SensorParameters(
    width=60,
    height=1,
    threshold_on=0.2,
    threshold_off=0.2,
    mismatch=0.03,
    dark_current_relative=1e-4,
    corner_hz_at_reference=300.0,
    corner_min_hz=1.0,
    corner_max_hz=3000.0,
    leak_hz=0.1,
    leak_spread=0.3,
)


def row(pixels=60, **changes):
    return dataclasses.replace(PLAIN, width=pixels, **changes)
