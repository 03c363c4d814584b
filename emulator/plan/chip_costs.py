"""Cost of leaving out an effect of the chip: temperature, imager, defects, radiation.

Each cost is a decision without its verdict; None where the effect is off. `dim` is dark current over the photocurrent
of the darkest active pixels: a change of the dark current, or of the light alone, by a share changes contrasts there by
that share of `dim`, and time constants by that share.
"""

from __future__ import annotations

import math
from typing import Any

from emulator.plan.decision import Decision, Tolerance, interval_s, least_current, over, tau_us, threshold
from emulator.plan.scene_probe import Probe
from emulator.sensor.chip.radiation import hits_per_second
from emulator.sensor.presets import SensorParameters

__all__ = ["chip_costs"]


def chip_costs(p: SensorParameters, scene: Probe, tolerance: Tolerance) -> list[Decision | None]:
    """Return the cost of each effect of the chip."""
    return [
        _dark_current(p, scene),
        _temperature(p, scene, tolerance),
        *_efficiencies(p, scene),
        _prnu(p, scene),
        _dcnu(p, scene),
        *_shot_noise(p, scene),
        _hot_pixels(p, scene),
        _dead_pixels(p),
        _radiation(p, scene),
        _dose(p, scene, tolerance),
    ]


def _dim(p: SensorParameters, scene: Probe) -> float:
    return min(1.0, p.dark_current_relative / least_current(p, scene))


def _dark_current(p: SensorParameters, scene: Probe) -> Decision:
    return Decision(
        "dark current", "its share of the darkest light; never left out", None, _dim(p, scene), choice=False
    )


def _temperature(p: SensorParameters, scene: Probe, tolerance: Tolerance) -> Decision | None:
    t = p.temperature
    warmer_k = t.celsius - t.reference_celsius
    if not warmer_k:
        return None
    more_leak = abs(2 ** (warmer_k / t.leak_doubles_every_k) - 1) * p.leak_hz * threshold(p)
    more_dark = abs(2 ** (warmer_k / t.dark_doubles_every_k) - 1)
    drift_us = min(over(more_leak * tolerance.duration_s, scene), interval_s(p, scene)) * 1e6 if more_leak else 0.0
    share = (over(more_leak, scene) if more_leak else 0.0) + more_dark * _dim(p, scene)
    off = {"temperature": {"celsius": t.reference_celsius}}
    return Decision("temperature", "change of leak and of dark current", drift_us, share, off)


def _efficiencies(p: SensorParameters, scene: Probe) -> list[Decision | None]:
    return [
        _of_light("system efficiency", abs(1 / p.imager.system_efficiency - 1), {"system_efficiency": 1.0}, p, scene),
        _of_light(
            "quantum efficiency", abs(1 / p.imager.quantum_efficiency - 1), {"quantum_efficiency": 1.0}, p, scene
        ),
    ]


def _prnu(p: SensorParameters, scene: Probe) -> Decision | None:
    return _of_light("PRNU", 2 * p.imager.prnu, {"prnu": 0.0}, p, scene)


def _dcnu(p: SensorParameters, scene: Probe) -> Decision | None:
    return _of_light("DCNU", 2 * p.imager.dcnu, {"dcnu": 0.0}, p, scene, of_dark=True)


def _of_light(
    name: str, change: float, off: dict[str, Any], p: SensorParameters, scene: Probe, *, of_dark: bool = False
) -> Decision | None:
    """Return the cost of an effect that changes light, or dark current, by a share."""
    if not change:
        return None
    dim = _dim(p, scene)
    lag_us = tau_us(p, least_current(p, scene)) * change * (dim if of_dark else 1 - dim)
    return Decision(name, "time constants and contrasts in the darkest light", lag_us, change * dim, {"imager": off})


def _shot_noise(p: SensorParameters, scene: Probe) -> list[Decision | None]:
    least = least_current(p, scene)
    dark = min(p.dark_current_relative, least)
    return [
        _counting("photon shot noise", p.imager.photon_shot_noise, least - dark, p, scene),
        _counting("dark shot noise", p.imager.dark_shot_noise, dark, p, scene),
    ]


def _counting(name: str, on: bool, counted: float, p: SensorParameters, scene: Probe) -> Decision | None:
    if not on:
        return None
    grid_s = p.imager.shot_grid_us * 1e-6
    deviation = math.sqrt(counted / (p.imager.electrons_per_s_at_reference * grid_s)) / least_current(p, scene)
    events_hz = math.erfc(threshold(p) / (2 * deviation)) / grid_s if deviation else 0.0
    jitter_us = over(deviation, scene) * 1e6 if deviation else 0.0
    share = over(events_hz * threshold(p), scene) if events_hz else 0.0
    off = {"imager": {name.replace(" ", "_"): False}}
    return Decision(name, "jitter of events, and events of its own", jitter_us, share, off)


def _hot_pixels(p: SensorParameters, scene: Probe) -> Decision | None:
    count = p.defects.hot_share * p.width * p.height + len(p.defects.hot_pixels)
    if not count:
        return None
    off = {"defects": {"hot_share": 0.0, "hot_pixels": ()}}
    return Decision("hot pixels", "their share of the stream", None, _of_stream(count * p.defects.hot_hz, scene), off)


def _dead_pixels(p: SensorParameters) -> Decision | None:
    share = p.defects.dead_share + len(p.defects.dead_pixels) / (p.width * p.height)
    off = {"defects": {"dead_share": 0.0, "dead_pixels": ()}}
    return Decision("dead pixels", "their share of the pixels", None, share, off) if share else None


def _radiation(p: SensorParameters, scene: Probe) -> Decision | None:
    r = p.radiation
    if not r.hits_per_cm2_s:
        return None
    pixels = 1 + 2 * r.depth_um / r.pixel_pitch_um  # mean length of an isotropic track, and the pixel it begins in
    share = _of_stream(hits_per_second(p) * pixels * (1 + r.off_share), scene)
    return Decision("radiation", "its share of the stream", None, share, {"radiation": {"hits_per_cm2_s": 0.0}})


def _dose(p: SensorParameters, scene: Probe, tolerance: Tolerance) -> Decision | None:
    r = p.radiation
    dose_krad = r.dose_krad + r.dose_krad_per_day * tolerance.duration_s / 86_400
    if not dose_krad * r.hot_share_per_krad:
        return None
    turned = -math.expm1(-dose_krad * r.hot_share_per_krad) * p.width * p.height
    off = {"radiation": {"dose_krad": 0.0, "dose_krad_per_day": 0.0}}
    return Decision("dose", "pixels it turns hot by the end", None, _of_stream(turned * p.defects.hot_hz, scene), off)


def _of_stream(events_per_s: float, scene: Probe) -> float:
    return events_per_s / max(scene.events_per_s, 1e-9)
