"""Effect of the chip's temperature on a sensor's figures: leak and dark current double every so many kelvin."""

from __future__ import annotations

import dataclasses

from emulator.sensor.presets import SensorParameters

__all__ = ["LEAST_DARK", "MOST_DARK", "MOST_HZ", "at_temperature"]

MOST_HZ = 10_000.0
"""Leak rate of any pixel, as in `defects`."""

LEAST_DARK, MOST_DARK = 1e-30, 1e6
"""Bounds of dark current over photocurrent at the reference light, for the float32 of the pixels."""


def at_temperature(p: SensorParameters) -> SensorParameters:
    """Return the sensor's figures at `temperature.celsius`, from those at the reference temperature.

    Hot pixels leak through a junction too, so their rate follows the leak's.

    Raises
    ------
    ValueError
        The pixels, hot ones where there are any, would leak at more than `MOST_HZ`, or the dark current would not lie
        between `LEAST_DARK` and `MOST_DARK`.
    """
    t = p.temperature
    warmer_k = t.celsius - t.reference_celsius
    leak = 2 ** (warmer_k / t.leak_doubles_every_k)
    hot_hz = p.defects.hot_hz * leak if _may_have_hot_pixels(p) else p.defects.hot_hz
    dark = p.dark_current_relative * 2 ** (warmer_k / t.dark_doubles_every_k)
    if warmer_k and max(p.leak_hz * leak, hot_hz) > MOST_HZ:
        raise ValueError(
            f"temperature.celsius = {t.celsius:g}: pixels would leak at {max(p.leak_hz * leak, hot_hz):.3g} Hz, and "
            f"{MOST_HZ:g} is the most; lower it, or leak_hz and defects.hot_hz"
        )
    if warmer_k and not LEAST_DARK <= dark <= MOST_DARK:
        raise ValueError(
            f"temperature.celsius = {t.celsius:g}: the dark current would be {dark:.3g} of the reference light"
        )
    return dataclasses.replace(
        p,
        leak_hz=p.leak_hz * leak,
        defects=dataclasses.replace(p.defects, hot_hz=hot_hz),
        dark_current_relative=dark,
        temperature=dataclasses.replace(t, reference_celsius=t.celsius),
    )


def _may_have_hot_pixels(p: SensorParameters) -> bool:
    return bool(p.defects.hot_share or p.defects.hot_pixels or p.radiation.dose_krad or p.radiation.dose_krad_per_day)
