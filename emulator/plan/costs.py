"""Costs of leaving out effects of the pixel and of the chip, from which `decide` makes its decisions.

Each cost is a decision without its verdict; an effect that is off has none. Effects of the chip are temperature,
imager, defects and radiation. `dim` is dark current over the photocurrent of the darkest active pixels: a change of the
dark current, or of the light alone, by a share changes contrasts there by that share of `dim`, and time constants by
that share.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
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


def pixel_costs(p: SensorParameters, scene: Probe, tolerance: Tolerance) -> Iterator[Decision]:
    """Yield the cost of each effect of the pixel that is switched on, in the order of the signal."""
    yield from _receptor_costs(p, scene)
    yield from _comparator_costs(p, scene, tolerance)
    yield from _reset_costs(p, scene)


def _receptor_costs(p: SensorParameters, scene: Probe) -> Iterator[Decision]:
    """Yield the costs up to the high-pass.

    The second pole and the slew of the circuit cost no more than one pole as the law of large signals, which is
    therefore not for choice.
    """
    least, largest = least_current(p, scene), max(_largest(scene), least_current(p, scene))
    is_circuit, has_low_pass = p.photoreceptor == "circuit", not math.isinf(p.corner_hz_at_reference)
    if has_low_pass and is_circuit:
        bound = "longest time constant; of the circuit, kept"
        yield Decision("low-pass", bound, tau_us(p, least), None, choice=False)
    elif has_low_pass:
        off: dict[str, Any] = {"corner_hz_at_reference": math.inf}
        yield Decision("low-pass", "longest time constant", tau_us(p, least), None, off)
    if has_low_pass and p.corner_min_hz != p.corner_max_hz:
        longest_us, shortest_us = tau_us(p, least), tau_us(p, largest)
        fixed_hz = 1e6 / (2 * math.pi * math.sqrt(longest_us * shortest_us))
        off = {"corner_min_hz": fixed_hz, "corner_max_hz": fixed_hz}
        bound = "time constants of the darkest and the brightest light"
        yield Decision("bandwidth following the light", bound, longest_us - shortest_us, None, off)
    if has_low_pass and p.photoreceptor != "large_signal" and not math.isinf(p.corner_max_hz):
        range_ln = math.log(max(_largest(scene) / least, 1.0))
        late_us = 1e6 * (1 + range_ln) / (2 * math.pi * p.corner_max_hz)
        off = {"photoreceptor": "large_signal"} if is_circuit else {}
        bound = "second pole, and slew over the range"
        yield Decision("large signals", bound, late_us, None, off, is_circuit, is_circuit)
    if p.source_follower_hz:
        off = {"noise": {"corner_hz": fixed_corner_hz(p)}} if p.noise.rms else {}  # noise, which keeps its band
        lag_us = 1e6 / (2 * math.pi * p.source_follower_hz)
        yield Decision("source follower", "its time constant", lag_us, None, {**off, "source_follower_hz": 0.0})
    if p.highpass_hz:
        time_constants = 2 * math.pi * p.highpass_hz * run_events(p, scene) * interval_s(p, scene)
        share = 1 + math.expm1(-time_constants) / time_constants  # 1 in a still scene
        yield Decision("high-pass", "events that a monotone run loses", None, share, {"highpass_hz": 0.0})


def _comparator_costs(p: SensorParameters, scene: Probe, tolerance: Tolerance) -> Iterator[Decision]:
    """Yield the costs of leaks, thresholds, noise and delays.

    That of comparators without delay is an upper bound of the later one's, at the mean contrast rate.
    """
    largest = _largest(scene) if math.isfinite(scene.largest_current) else 0.0
    leaks: tuple[tuple[str, float, dict[str, Any]], ...] = (
        ("leak", p.leak_hz, {"leak_hz": 0.0}),
        ("leak spread", p.leak_hz * p.leak_spread, {"leak_spread": 0.0}),
        ("leak jitter", p.leak_hz * p.jitter.leak_share, {"jitter": {"leak_share": 0.0}}),
        ("parasitic", p.parasitic_hz_at_reference * largest, {"parasitic_hz_at_reference": 0.0}),
    )
    for name, rate_hz, off in leaks:
        if rate_hz:
            slope = rate_hz * threshold(p)
            drift_us = min(over(slope * tolerance.duration_s, scene), interval_s(p, scene)) * 1e6
            yield Decision(name, "drift of the stamps, and its share of the events", drift_us, over(slope, scene), off)
    if p.mismatch:
        off_us = over(run_events(p, scene) * p.mismatch * threshold(p), scene) * 1e6
        yield Decision("mismatch", "stamps at the end of a monotone run", off_us, None, {"mismatch": 0.0})
    if p.refractory_us:
        late_us, share = run_events(p, scene) * p.refractory_us, p.refractory_us * 1e-6 / interval_s(p, scene)
        yield Decision("refractory period", "stamps in a run, and events lost", late_us, share, {"refractory_us": 0.0})
    if p.noise.rms:
        darkest, brightest = _corner_hz(p, p.dark_current_relative), _corner_hz(p, _largest(scene))
        f = np.geomspace(darkest, brightest, 20) if math.isfinite(brightest) else np.full(1, math.inf)
        share = over(max(0.0, *(sum(still_hz(p, float(hz))) - p.leak_hz for hz in np.unique(f))) * threshold(p), scene)
        jitter_us = over(p.noise.rms, scene) * 1e6
        yield Decision("noise", "jitter of events, and noise events", jitter_us, share, {"noise": {"rms": 0.0}})
    if p.jitter.latency_us:
        late_us = p.jitter.latency_us + 2 * p.jitter.deviation_us
        off = {"jitter": {"latency_us": 0.0, "deviation_us": 0.0, "off_latency_us": 0.0, "late_share": 0.0}}
        yield Decision("jitter", "latency and two deviations", late_us, None, off)
    c = p.comparator
    if max(c.on_us, c.off_us):
        late_us, unit_us = math.inf, over(c.contrast_per_e, scene) * 1e6
        if math.isfinite(unit_us):
            on, off_e = c.on_us / unit_us, c.off_us / unit_us  # see `sensor.pixels.event_time`
            late_us = unit_us * max(math.log1p(on + math.sqrt(2 * on)), off_e + min(1.0, math.sqrt(2 * off_e)))
        share = late_us * 1e-6 / interval_s(p, scene) if math.isfinite(late_us) else math.inf
        bound, off = (
            "delay at the mean contrast rate, and events lost in it",
            {"comparator": {"on_us": 0.0, "off_us": 0.0}},
        )
        yield Decision("comparator", bound, late_us, share, off)


def _reset_costs(p: SensorParameters, scene: Probe) -> Iterator[Decision]:
    """Yield the costs of the reset; without the acknowledge, pixels would not wait for the read-out."""
    n = run_events(p, scene)
    offset, noise = abs(p.reset.offset), p.reset.noise
    if offset:
        off_us, share = over(n * offset, scene) * 1e6, offset / min(p.threshold_on, p.threshold_off)
        bound = "stamps in a run, and its share of a threshold"
        yield Decision("reset offset", bound, off_us, share, {"reset": {"offset": 0.0}})
    if noise:
        off_us = over(2 * math.sqrt(n) * noise, scene) * 1e6
        yield Decision("reset noise", "two deviations of the stamps in a run", off_us, None, {"reset": {"noise": 0.0}})
    if p.reset.at_acknowledge:
        wait_us = _mean_wait_us(p, scene.events_per_s)
        share = wait_us / (interval_s(p, scene) * 1e6) if math.isfinite(wait_us) else math.inf
        bound = "mean wait at the read-out: stamps in a run, and events lost"
        yield Decision("acknowledge", bound, n * wait_us, share, {"reset": {"at_acknowledge": False}})


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


def chip_costs(p: SensorParameters, scene: Probe, tolerance: Tolerance) -> Iterator[Decision]:
    """Yield the cost of each effect of the chip that is switched on."""
    imager, t = p.imager, p.temperature
    dim = min(1.0, p.dark_current_relative / least_current(p, scene))
    yield Decision("dark current", "its share of the darkest light; never left out", None, dim, choice=False)
    if t.warmer_k:
        more_leak = abs(t.leak_factor - 1) * p.leak_hz * threshold(p)
        drift_us = min(over(more_leak * tolerance.duration_s, scene), interval_s(p, scene)) * 1e6 if more_leak else 0.0
        share = (over(more_leak, scene) if more_leak else 0.0) + abs(t.dark_factor - 1) * dim
        off: dict[str, Any] = {"temperature": {"celsius": REFERENCE_CELSIUS}}
        yield Decision("temperature", "change of leak and of dark current", drift_us, share, off)
    of_light: tuple[tuple[str, float, float, dict[str, Any]], ...] = (  # a change of light, or of dark current
        ("system efficiency", abs(1 / imager.system_efficiency - 1), 1 - dim, {"system_efficiency": 1.0}),
        ("quantum efficiency", abs(1 / imager.quantum_efficiency - 1), 1 - dim, {"quantum_efficiency": 1.0}),
        ("PRNU", 2 * imager.prnu, 1 - dim, {"prnu": 0.0}),
        ("DCNU", 2 * imager.dcnu, dim, {"dcnu": 0.0}),
    )
    for name, change, changed_share, off in of_light:
        if change:
            lag_us = tau_us(p, least_current(p, scene)) * change * changed_share
            bound = "time constants and contrasts in the darkest light"
            yield Decision(name, bound, lag_us, change * dim, {"imager": off})
    yield from _shot_noise_costs(p, scene)
    yield from _defect_costs(p, scene, tolerance)


def _shot_noise_costs(p: SensorParameters, scene: Probe) -> Iterator[Decision]:
    least = least_current(p, scene)
    dark = min(p.dark_current_relative, least)
    of_photons = "photon shot noise", p.imager.photon_shot_noise, least - dark
    for name, on, counted in (of_photons, ("dark shot noise", p.imager.dark_shot_noise, dark)):
        if on:
            grid_s = p.imager.shot_grid_us * 1e-6
            deviation = math.sqrt(counted / (p.imager.electrons_per_s_at_reference * grid_s)) / least
            events_hz = math.erfc(threshold(p) / (2 * deviation)) / grid_s if deviation else 0.0
            jitter_us = over(deviation, scene) * 1e6 if deviation else 0.0
            share = over(events_hz * threshold(p), scene) if events_hz else 0.0
            off = {"imager": {name.replace(" ", "_"): False}}
            yield Decision(name, "jitter of events, and events of its own", jitter_us, share, off)


def _defect_costs(p: SensorParameters, scene: Probe, tolerance: Tolerance) -> Iterator[Decision]:
    d, r = p.defects, p.radiation
    if count := d.hot_share * p.width * p.height + len(d.hot_pixels):
        off: dict[str, Any] = {"defects": {"hot_share": 0.0, "hot_pixels": ()}}
        yield Decision("hot pixels", "their share of the stream", None, _of_stream(count * d.hot_hz, scene), off)
    if share := d.dead_share + len(d.dead_pixels) / (p.width * p.height):
        off = {"defects": {"dead_share": 0.0, "dead_pixels": ()}}
        yield Decision("dead pixels", "their share of the pixels", None, share, off)
    if r.hits_per_cm2_s:
        track = 1 + 2 * r.depth_um / r.pixel_pitch_um  # mean length of an isotropic track, and the pixel it begins in
        share = _of_stream(hits_per_second(p) * track * (1 + r.off_share), scene)
        yield Decision("radiation", "its share of the stream", None, share, {"radiation": {"hits_per_cm2_s": 0.0}})
    dose_krad = r.dose_krad + r.dose_krad_per_day * tolerance.duration_s / 86_400
    if dose_krad * r.hot_share_per_krad:
        turned = -math.expm1(-dose_krad * r.hot_share_per_krad) * p.width * p.height
        off = {"radiation": {"dose_krad": 0.0, "dose_krad_per_day": 0.0}}
        yield Decision("dose", "pixels it turns hot by the end", None, _of_stream(turned * d.hot_hz, scene), off)


def _of_stream(events_per_s: float, scene: Probe) -> float:
    return events_per_s / max(scene.events_per_s, 1e-9)
