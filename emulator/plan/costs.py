"""Costs of leaving out effects of the pixel and of the chip, from which `decide` makes its decisions.

Each cost is a decision without its verdict; None where the effect is off. Effects of the chip are temperature, imager,
defects and radiation. `dim` is dark current over the photocurrent of the darkest active pixels: a change of the dark
current, or of the light alone, by a share changes contrasts there by that share of `dim`, and time constants by that
share.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from emulator.optics.lens import LensParameters
from emulator.plan.scene_probe import Probe
from emulator.sensor.chip.sources import hits_per_second
from emulator.sensor.noise.law import fixed_corner_hz, still_hz
from emulator.sensor.parameters import REFERENCE_CELSIUS
from emulator.sensor.presets import SensorParameters

EFFECTS = (
    *("low-pass", "bandwidth following the light", "large signals", "source follower", "high-pass"),
    *("leak", "leak spread", "leak jitter", "parasitic", "mismatch", "refractory period"),
    *("noise", "jitter", "comparator", "reset offset", "reset noise", "acknowledge"),
    *("dark current", "temperature", "system efficiency", "quantum efficiency", "PRNU", "DCNU"),
    *("photon shot noise", "dark shot noise", "hot pixels", "dead pixels", "radiation", "dose"),
    "veiling glare",
)
"""All effects that a plan can decide on; one that a plan lacks is switched off."""

SHAPES_NOISE = {
    *("low-pass", "bandwidth following the light", "high-pass", "leak", "parasitic", "mismatch"),
    *("refractory period", "reset offset", "reset noise", "temperature"),
}
"""Effects on which the rate of noise events depends; their costs leave this out."""


@dataclass(frozen=True)
class Tolerance:
    """Tolerated errors of a run: timestamps by `eps_us` (95 %), and a share of its events; it lasts `duration_s`."""

    eps_us: float
    wrong_share: float
    duration_s: float


@dataclass(frozen=True)
class Decision:
    """One effect, kept or dropped.

    Attributes
    ----------
    bound : the compared quantity, in words.
    cost_us, cost_share : error accepted or avoided: of timestamps, us, and as a share of the events; None: it has none.
    changes : changes in SensorParameters that drop the effect; for a table, the changes in it.
    choice : False for an effect that cannot be left out, which is kept at any cost, and for one that the method does
        not have, which is left out.
    kept : the verdict.
    """

    effect: str
    bound: str
    cost_us: float | None
    cost_share: float | None
    changes: dict[str, Any] = field(default_factory=dict)
    choice: bool = True
    kept: bool = True


def threshold(p: SensorParameters) -> float:
    """Return the mean of both thresholds."""
    return (p.threshold_on + p.threshold_off) / 2


def over(amount: float, scene: Probe) -> float:
    """Return `amount` over the contrast rate; infinite in a still scene, where effects are the only events."""
    return amount / scene.contrast_rate if scene.contrast_rate > 0 else math.inf


def interval_s(p: SensorParameters, scene: Probe) -> float:
    """Return the time between two events of a pixel, s."""
    return over(threshold(p), scene)


def run_events(p: SensorParameters, scene: Probe) -> float:
    """Return the events of a monotone run from the darkest to the brightest of the active light; at least one."""
    if not (math.isfinite(scene.least_current) and scene.least_current > 0):
        return 1.0
    return max(1.0, math.log(scene.largest_current / scene.least_current) / threshold(p))


def least_current(p: SensorParameters, scene: Probe) -> float:
    """Return the photocurrent of the darkest active pixels; in a still scene, that in the dark."""
    return scene.least_current if math.isfinite(scene.least_current) else p.dark_current_relative


def tau_us(p: SensorParameters, current: float) -> float:
    """Return the photoreceptor's time constant at a photocurrent, us; 0 without a low-pass."""
    if math.isinf(p.corner_hz_at_reference):
        return 0.0
    corner_hz = min(max(p.corner_hz_at_reference * current, p.corner_min_hz), p.corner_max_hz)
    return 1e6 / (2 * math.pi * corner_hz)


def pixel_costs(p: SensorParameters, scene: Probe, tolerance: Tolerance) -> list[Decision | None]:
    """Return the cost of each effect of the pixel."""
    return [
        _low_pass(p, scene),
        _bandwidth(p, scene),
        _large_signals(p, scene),
        _source_follower(p),
        _high_pass(p, scene),
        *_leaks(p, scene, tolerance),
        _mismatch(p, scene),
        _refractory(p, scene),
        _noise(p, scene),
        _jitter(p),
        _comparator(p, scene),
        *_resets(p, scene),
        _acknowledge(p, scene),
    ]


def _low_pass(p: SensorParameters, scene: Probe) -> Decision | None:
    if math.isinf(p.corner_hz_at_reference):
        return None
    lag_us = tau_us(p, least_current(p, scene))
    if p.photoreceptor == "circuit":
        return Decision("low-pass", "longest time constant; of the circuit, kept", lag_us, None, choice=False)
    return Decision("low-pass", "longest time constant", lag_us, None, {"corner_hz_at_reference": math.inf})


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
    """Return the cost of a photoreceptor without the circuit's second pole, and its slew over the range of light.

    The law of large signals costs no more than one pole, so it is not for choice.
    """
    if p.photoreceptor == "large_signal":
        return None
    if math.isinf(p.corner_hz_at_reference) or math.isinf(p.corner_max_hz):
        return None
    least = least_current(p, scene)
    range_ln = math.log(max(_largest(scene) / least, 1.0))
    late_us = 1e6 * (1 + range_ln) / (2 * math.pi * p.corner_max_hz)
    is_circuit = p.photoreceptor == "circuit"
    changes = {"photoreceptor": "large_signal"} if is_circuit else {}
    return Decision(
        "large signals", "second pole, and slew over the range", late_us, None, changes, is_circuit, is_circuit
    )


def _source_follower(p: SensorParameters) -> Decision | None:
    if not p.source_follower_hz:
        return None
    lag_us = 1e6 / (2 * math.pi * p.source_follower_hz)
    noise: dict[str, Any] = {"noise": {"corner_hz": fixed_corner_hz(p)}} if p.noise.rms else {}  # which keeps its band
    return Decision("source follower", "its time constant", lag_us, None, {**noise, "source_follower_hz": 0.0})


def _high_pass(p: SensorParameters, scene: Probe) -> Decision | None:
    if not p.highpass_hz:
        return None
    time_constants = 2 * math.pi * p.highpass_hz * run_events(p, scene) * interval_s(p, scene)
    share = 1 + math.expm1(-time_constants) / time_constants  # 1 in a still scene
    return Decision("high-pass", "events that a monotone run loses", None, share, {"highpass_hz": 0.0})


def _leaks(p: SensorParameters, scene: Probe, tolerance: Tolerance) -> list[Decision | None]:
    largest = _largest(scene) if math.isfinite(scene.largest_current) else 0.0
    off: tuple[tuple[str, float, dict[str, Any]], ...] = (
        ("leak", p.leak_hz, {"leak_hz": 0.0}),
        ("leak spread", p.leak_hz * p.leak_spread, {"leak_spread": 0.0}),
        ("leak jitter", p.leak_hz * p.jitter.leak_share, {"jitter": {"leak_share": 0.0}}),
        ("parasitic", p.parasitic_hz_at_reference * largest, {"parasitic_hz_at_reference": 0.0}),
    )
    decisions: list[Decision | None] = []
    for name, rate_hz, changes in off:
        if rate_hz:
            slope = rate_hz * threshold(p)
            drift_us = min(over(slope * tolerance.duration_s, scene), interval_s(p, scene)) * 1e6
            bound = "drift of the stamps, and its share of the events"
            decisions.append(Decision(name, bound, drift_us, over(slope, scene), changes))
    return decisions


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
    share = over(max(0.0, *(sum(still_hz(p, float(hz))) - p.leak_hz for hz in np.unique(f))) * threshold(p), scene)
    jitter_us = over(p.noise.rms, scene) * 1e6
    return Decision("noise", "jitter of events, and noise events", jitter_us, share, {"noise": {"rms": 0.0}})


def _jitter(p: SensorParameters) -> Decision | None:
    if not p.jitter.latency_us:
        return None
    late_us = p.jitter.latency_us + 2 * p.jitter.deviation_us
    off = {"jitter": {"latency_us": 0.0, "deviation_us": 0.0, "off_latency_us": 0.0, "late_share": 0.0}}
    return Decision("jitter", "latency and two deviations", late_us, None, off)


def _comparator(p: SensorParameters, scene: Probe) -> Decision | None:
    """Return the cost of comparators without delay: an upper bound of the later one's, at the mean contrast rate."""
    c = p.comparator
    if not max(c.on_us, c.off_us):
        return None
    late_us, unit_us = math.inf, over(c.contrast_per_e, scene) * 1e6
    if math.isfinite(unit_us):
        on, off = c.on_us / unit_us, c.off_us / unit_us  # see `sensor.pixels.event_time`
        late_us = unit_us * max(math.log1p(on + math.sqrt(2 * on)), off + min(1.0, math.sqrt(2 * off)))
    none = {"comparator": {"on_us": 0.0, "off_us": 0.0}}
    share = late_us * 1e-6 / interval_s(p, scene) if math.isfinite(late_us) else math.inf
    return Decision("comparator", "delay at the mean contrast rate, and events lost in it", late_us, share, none)


def _resets(p: SensorParameters, scene: Probe) -> list[Decision | None]:
    n, decisions = run_events(p, scene), list[Decision | None]()
    offset, noise = abs(p.reset.offset), p.reset.noise
    if offset:
        bound, share = "stamps in a run, and its share of a threshold", offset / min(p.threshold_on, p.threshold_off)
        off_us = over(n * offset, scene) * 1e6
        decisions.append(Decision("reset offset", bound, off_us, share, {"reset": {"offset": 0.0}}))
    if noise:
        off_us = over(2 * math.sqrt(n) * noise, scene) * 1e6
        bound = "two deviations of the stamps in a run"
        decisions.append(Decision("reset noise", bound, off_us, None, {"reset": {"noise": 0.0}}))
    return decisions


def _acknowledge(p: SensorParameters, scene: Probe) -> Decision | None:
    """Return the cost of a refractory period from the crossing: pixels would not wait for the read-out."""
    if not p.reset.at_acknowledge:
        return None
    wait_us = _mean_wait_us(p, scene.events_per_s)
    late_us, interval_us = run_events(p, scene) * wait_us, interval_s(p, scene) * 1e6
    share = wait_us / interval_us if math.isfinite(wait_us) else math.inf
    bound = "mean wait at the read-out: stamps in a run, and events lost"
    return Decision("acknowledge", bound, late_us, share, {"reset": {"at_acknowledge": False}})


def _mean_wait_us(p: SensorParameters, events_per_s: float) -> float:
    """Return the mean time from a request to its acknowledge, us: half a scan, or that of a queue (M/D/1) and a row."""
    if p.readout.scan_us:
        return p.readout.scan_us / 2
    service_us = (p.readout.event_ns + p.readout.row_ns) / 1000
    load = events_per_s * service_us * 1e-6
    queue_us = service_us * load / (2 * (1 - load)) if load < 1 else math.inf
    return p.readout.row_ns / 1000 + queue_us


def lens_costs(lens: LensParameters, p: SensorParameters, scene: Probe) -> list[Decision]:
    """Return the cost of each effect of the lens that is switched on."""
    if not lens.veiling_glare + lens.halo:
        return []
    share = min(1.0, (lens.veiling_glare + lens.halo) * scene.mean_current / least_current(p, scene))
    return [Decision("veiling glare", "its share of the darkest light; never left out", None, share, choice=False)]


def _largest(scene: Probe) -> float:
    return scene.largest_current if math.isfinite(scene.largest_current) else 1.0


def _corner_hz(p: SensorParameters, current: float) -> float:
    tau = tau_us(p, current)
    return 1e6 / (2 * math.pi * tau) if tau else math.inf


def chip_costs(p: SensorParameters, scene: Probe, tolerance: Tolerance) -> list[Decision | None]:
    """Return the cost of each effect of the chip."""
    imager = p.imager
    return [
        Decision("dark current", "its share of the darkest light; never left out", None, _dim(p, scene), choice=False),
        _temperature(p, scene, tolerance),
        _of_light("system efficiency", abs(1 / imager.system_efficiency - 1), {"system_efficiency": 1.0}, p, scene),
        _of_light("quantum efficiency", abs(1 / imager.quantum_efficiency - 1), {"quantum_efficiency": 1.0}, p, scene),
        _of_light("PRNU", 2 * imager.prnu, {"prnu": 0.0}, p, scene),
        _of_light("DCNU", 2 * imager.dcnu, {"dcnu": 0.0}, p, scene, of_dark=True),
        *_shot_noise(p, scene),
        _hot_pixels(p, scene),
        _dead_pixels(p),
        _radiation(p, scene),
        _dose(p, scene, tolerance),
    ]


def _dim(p: SensorParameters, scene: Probe) -> float:
    return min(1.0, p.dark_current_relative / least_current(p, scene))


def _temperature(p: SensorParameters, scene: Probe, tolerance: Tolerance) -> Decision | None:
    t = p.temperature
    if not t.warmer_k:
        return None
    more_leak = abs(t.leak_factor - 1) * p.leak_hz * threshold(p)
    more_dark = abs(t.dark_factor - 1)
    drift_us = min(over(more_leak * tolerance.duration_s, scene), interval_s(p, scene)) * 1e6 if more_leak else 0.0
    share = (over(more_leak, scene) if more_leak else 0.0) + more_dark * _dim(p, scene)
    off = {"temperature": {"celsius": REFERENCE_CELSIUS}}
    return Decision("temperature", "change of leak and of dark current", drift_us, share, off)


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
