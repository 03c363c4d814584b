"""Cost of leaving out an effect of the pixel: a decision without its verdict; None where the effect is off.

The shift of events by noise is that of a ramp through a threshold with one-pole noise on it, in units of rms over
contrast rate A, against rho = A tau_n / rms; simulated, 4000 crossings a column, the same for thresholds of 3 to 15
rms (`tests/emulator/sensor/noise/test_noise_shift.py` holds the pixels of the grid grade against it):

    rho        0.1     0.3     1      3      10
    mean      -1.87   -1.32   -.71   -.31   -.09
    deviation   .58     .72    .86    .96   1.0
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from emulator.plan.decision import Decision, Tolerance, interval_s, least_current, over, run_events, tau_us, threshold
from emulator.plan.scene_probe import Probe
from emulator.sensor.noise.law import bandwidth_hz, beyond_the_law, fixed_corner_hz, of_array, rms
from emulator.sensor.presets import SensorParameters

__all__ = ["noise_shift", "pixel_costs"]

_RHO = (0.1, 0.3, 1.0, 3.0, 10.0)
_EARLIER = (1.87, 1.32, 0.71, 0.31, 0.09)
_DEVIATION = (0.58, 0.72, 0.86, 0.96, 1.0)
_Q95 = 1.645
_FASTEST_HZ = 1e6
_LEAST_RHO = 0.3  # of a point process


def pixel_costs(p: SensorParameters, scene: Probe, tolerance: Tolerance) -> list[Decision | None]:
    """Return the cost of each effect of the pixel."""
    return [
        _low_pass(p, scene),
        _bandwidth(p, scene),
        _large_signals(p, scene),
        _source_follower(p),
        *_leaks(p, scene, tolerance),
        _mismatch(p, scene),
        _refractory(p, scene),
        _noise(p, scene),
        _shift(p, scene),
        _jitter(p),
    ]


def noise_shift(rho: float) -> tuple[float, float]:
    """Return the mean time by which noise makes events earlier, and its deviation, in rms over contrast rate."""
    place = math.log(rho)
    nodes = np.log(_RHO)
    return float(np.interp(place, nodes, _EARLIER)), float(np.interp(place, nodes, _DEVIATION))


def _low_pass(p: SensorParameters, scene: Probe) -> Decision | None:
    if math.isinf(p.corner_hz_at_reference):
        return None
    lag_us = tau_us(p, least_current(p, scene))
    if p.photoreceptor == "large_signal":
        return Decision("low-pass", "longest time constant; of the circuit, kept", lag_us, None, choice=False)
    limits_noise = p.noise.rms and math.isinf(fixed_corner_hz(p))
    noise: dict[str, Any] = {"noise": {"corner_hz": min(p.corner_max_hz, _FASTEST_HZ)}} if limits_noise else {}
    return Decision("low-pass", "longest time constant", lag_us, None, {**noise, "corner_hz_at_reference": math.inf})


def _bandwidth(p: SensorParameters, scene: Probe) -> Decision | None:
    if math.isinf(p.corner_hz_at_reference) or p.corner_min_hz == p.corner_max_hz:
        return None
    least, largest = least_current(p, scene), max(_largest(scene), least_current(p, scene))
    longest_us, shortest_us = tau_us(p, least), tau_us(p, largest)
    fixed_hz = 1e6 / (2 * math.pi * math.sqrt(longest_us * shortest_us))
    frozen = {"corner_min_hz": fixed_hz, "corner_max_hz": fixed_hz}
    bound = "time constants of the darkest and the brightest light"
    return Decision("bandwidth following the light", bound, longest_us - shortest_us, None, frozen)


def _large_signals(p: SensorParameters, scene: Probe) -> Decision | None:
    """Return the cost of a one-pole photoreceptor: its second pole, and its slew over the scene's range of light."""
    if math.isinf(p.corner_hz_at_reference) or math.isinf(p.corner_max_hz):
        return None
    least = least_current(p, scene)
    range_ln = math.log(max(_largest(scene) / least, 1.0))
    late_us = 1e6 * (1 + range_ln) / (2 * math.pi * p.corner_max_hz)
    here = p.photoreceptor == "large_signal"
    changes = {"photoreceptor": "one_pole"} if here else {}
    return Decision("large signals", "second pole, and slew over the range", late_us, None, changes, here, here)


def _source_follower(p: SensorParameters) -> Decision | None:
    if not p.source_follower_hz:
        return None
    lag_us = 1e6 / (2 * math.pi * p.source_follower_hz)
    noise: dict[str, Any] = {"noise": {"corner_hz": fixed_corner_hz(p)}} if p.noise.rms else {}  # which keeps its band
    return Decision("source follower", "its time constant", lag_us, None, {**noise, "source_follower_hz": 0.0})


def _leaks(p: SensorParameters, scene: Probe, tolerance: Tolerance) -> list[Decision | None]:
    largest = _largest(scene) if math.isfinite(scene.largest_current) else 0.0
    off: tuple[tuple[str, float, dict[str, Any]], ...] = (
        ("leak", p.leak_hz, {"leak_hz": 0.0}),
        ("leak spread", p.leak_hz * p.leak_spread, {"leak_spread": 0.0}),
        ("leak jitter", p.leak_hz * p.jitter.leak_share, {"jitter": {"leak_share": 0.0}}),
        ("parasitic", p.parasitic_hz_at_reference * largest, {"parasitic_hz_at_reference": 0.0}),
    )
    return [_leaking(name, rate_hz, changes, p, (scene, tolerance)) for name, rate_hz, changes in off]


def _leaking(
    name: str, rate_hz: float, changes: dict[str, Any], p: SensorParameters, given: tuple[Probe, Tolerance]
) -> Decision | None:
    if not rate_hz:
        return None
    scene, tolerance = given
    drift_us = min(over(rate_hz * threshold(p) * tolerance.duration_s, scene), interval_s(p, scene)) * 1e6
    share = over(rate_hz * threshold(p), scene)
    return Decision(name, "drift of the stamps, and its share of the events", drift_us, share, changes)


def _mismatch(p: SensorParameters, scene: Probe) -> Decision | None:
    if not p.mismatch:
        return None
    off_us = over(run_events(p, scene) * p.mismatch * threshold(p), scene) * 1e6
    return Decision("mismatch", "stamps at the end of a monotone run", off_us, None, {"mismatch": 0.0})


def _refractory(p: SensorParameters, scene: Probe) -> Decision | None:
    if not p.refractory_us:
        return None
    share = p.refractory_us * 1e-6 / interval_s(p, scene)
    late_us = run_events(p, scene) * p.refractory_us
    return Decision("refractory period", "stamps in a run, and events lost", late_us, share, {"refractory_us": 0.0})


def _noise(p: SensorParameters, scene: Probe) -> Decision | None:
    if not p.noise.rms:
        return None
    darkest, brightest = _corner_hz(p, p.dark_current_relative), _corner_hz(p, _largest(scene))
    f = np.geomspace(darkest, brightest, 20) if math.isfinite(brightest) else np.full(1, math.inf)
    rates = of_array(p, np.asarray(threshold(p)), f)
    share = over(float((rates.on + rates.off).max()) * threshold(p), scene)
    jitter_us = over(p.noise.rms, scene) * 1e6
    return Decision("noise", "jitter of events, and noise events", jitter_us, share, {"noise": {"rms": 0.0}})


def _shift(p: SensorParameters, scene: Probe) -> Decision | None:
    """Return the cost of a noise without voltage in time: it would make real events earlier and scatter them."""
    if not p.noise.rms:
        return None
    f = np.asarray(_corner_hz(p, least_current(p, scene)))
    sigma, bandwidth = float(rms(p, f)), float(bandwidth_hz(p, f))
    tau_s = 1 / (2 * math.pi * bandwidth)
    rho = max(scene.contrast_rate * tau_s / sigma, 1e-9)
    earlier, deviation = noise_shift(rho)
    shift_us = over(sigma, scene) * (earlier + _Q95 * deviation) * 1e6
    beyond = "noise decides whether" if rho < _LEAST_RHO else beyond_the_law(p, f)
    share = math.inf if beyond else None
    bound = f"beyond a point process: {beyond}" if beyond else "events brought forward by noise"
    on_grid = p.noise.grade == "grid"
    changes = {"noise": {"grade": "points"}} if on_grid else {}
    return Decision("shift by noise", bound, shift_us, share, changes, choice=on_grid, kept=on_grid)


def _jitter(p: SensorParameters) -> Decision | None:
    if not p.jitter.latency_us:
        return None
    late_us = p.jitter.latency_us + 2 * p.jitter.deviation_us
    off = {"jitter": {"latency_us": 0.0, "deviation_us": 0.0}}
    return Decision("jitter", "latency and two deviations", late_us, None, off)


def _largest(scene: Probe) -> float:
    return scene.largest_current if math.isfinite(scene.largest_current) else 1.0


def _corner_hz(p: SensorParameters, current: float) -> float:
    tau = tau_us(p, current)
    return 1e6 / (2 * math.pi * tau) if tau else math.inf
