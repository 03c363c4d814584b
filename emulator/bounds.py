"""What may be left out of a model, and the bound that says so.

A is the scene's contrast rate, C its bend (see `probe`), theta the threshold, T the run's length, N = A T / theta the
events that an active pixel raises, n the events of one monotone run, eps the tolerated timestamp error, delta the
tolerated share of wrong events.

    effect            what dropping it costs                             dropped when
    low-pass          every stamp early by tau                           the longest tau < eps
    source follower   every stamp early by 1/lambda2                     1/lambda2 < eps
    leak              R T events a pixel; stamps drift by R theta T/A    R T < delta N, and the drift < eps
    parasitic         the same, R proportional to light                  the same
    mismatch          stamps off by n sigma theta / A                    that < eps
    refractory        t_ref A/theta of the events; stamps by n t_ref     that < delta, and n t_ref < eps
    noise             R events a second; stamps off by rms / A           R < delta A/theta, and rms / A < eps
    jitter            stamps early by the latency                        latency + 2 deviations < eps
    hot pixels        their events                                       less than delta of the stream
    radiation         its events                                         less than delta of the stream

Mismatch and leak change sequences early: they go only from runs that tolerate it. Effects that a rig has switched off
are not modelled anyway and have no bound.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

from emulator.probe import Probe
from emulator.sensor.presets import SensorParameters

__all__ = ["Decision", "Tolerance", "decide", "without"]


@dataclass(frozen=True)
class Tolerance:
    """What a run may get wrong: timestamps by `eps_us` (95 %), and a share of its events; it lasts `duration_s`."""

    eps_us: float
    wrong_share: float
    duration_s: float


@dataclass(frozen=True)
class Decision:
    """One effect, kept or dropped.

    Attributes
    ----------
    bound
        What was compared, in words.
    cost_us, cost_share
        Error accepted or avoided: of timestamps, us, and as a share of the events; None where it has none.
    changes
        What to change in SensorParameters to drop the effect.
    """

    effect: str
    kept: bool
    bound: str
    cost_us: float | None
    cost_share: float | None
    changes: dict[str, Any]


def decide(sensor: SensorParameters, scene: Probe, tolerance: Tolerance) -> list[Decision]:
    """Return a decision for each effect that `sensor` has switched on."""
    costs = [cost for cost in _costs(sensor, scene, tolerance) if cost is not None]
    return [_judge(cost, tolerance) for cost in costs]


def without(sensor: SensorParameters, decisions: list[Decision]) -> SensorParameters:
    """Return `sensor` without the effects that were dropped."""
    for decision in decisions:
        if not decision.kept:
            sensor = dataclasses.replace(sensor, **decision.changes)
    return sensor


def _judge(cost: Decision, tolerance: Tolerance) -> Decision:
    too_late = cost.cost_us is not None and not cost.cost_us < tolerance.eps_us
    too_many = cost.cost_share is not None and not cost.cost_share < tolerance.wrong_share
    return dataclasses.replace(cost, kept=too_late or too_many)


def _costs(sensor: SensorParameters, scene: Probe, tolerance: Tolerance) -> list[Decision | None]:
    return [
        _low_pass(sensor, scene),
        _source_follower(sensor),
        _leak(sensor, scene, tolerance),
        _parasitic(sensor, scene, tolerance),
        _mismatch(sensor, scene),
        _refractory(sensor, scene),
        _noise(sensor, scene),
        _jitter(sensor),
        _hot_pixels(sensor, scene),
        _radiation(sensor, scene),
    ]


def _low_pass(p: SensorParameters, scene: Probe) -> Decision | None:
    if math.isinf(p.corner_hz_at_reference):
        return None
    current = scene.least_current if math.isfinite(scene.least_current) else p.dark_current_relative
    corner_hz = min(max(p.corner_hz_at_reference * current, p.corner_min_hz), p.corner_max_hz)
    tau_us = 1e6 / (2 * math.pi * corner_hz)
    return Decision("low-pass", True, "longest time constant", tau_us, None, {"corner_hz_at_reference": math.inf})


def _source_follower(p: SensorParameters) -> Decision | None:
    if not p.source_follower_hz:
        return None
    tau_us = 1e6 / (2 * math.pi * p.source_follower_hz)
    return Decision("source follower", True, "its time constant", tau_us, None, {"source_follower_hz": 0.0})


def _leak(p: SensorParameters, scene: Probe, tolerance: Tolerance) -> Decision | None:
    return _leaking("leak", p.leak_hz, {"leak_hz": 0.0}, p, (scene, tolerance))


def _parasitic(p: SensorParameters, scene: Probe, tolerance: Tolerance) -> Decision | None:
    rate_hz = p.parasitic_hz_at_reference * (scene.largest_current if math.isfinite(scene.largest_current) else 0.0)
    return _leaking("parasitic", rate_hz, {"parasitic_hz_at_reference": 0.0}, p, (scene, tolerance))


def _leaking(
    name: str, rate_hz: float, changes: dict[str, Any], p: SensorParameters, given: tuple[Probe, Tolerance]
) -> Decision | None:
    if not rate_hz:
        return None
    scene, tolerance = given
    drift_us = min(_over(rate_hz * _threshold(p) * tolerance.duration_s, scene), _interval_s(p, scene)) * 1e6
    share = _over(rate_hz * _threshold(p), scene)
    return Decision(name, True, "drift of the stamps, and its share of the events", drift_us, share, changes)


def _mismatch(p: SensorParameters, scene: Probe) -> Decision | None:
    if not p.mismatch:
        return None
    off_us = _over(_run_events(p, scene) * p.mismatch * _threshold(p), scene) * 1e6
    return Decision("mismatch", True, "stamps at the end of a monotone run", off_us, None, {"mismatch": 0.0})


def _refractory(p: SensorParameters, scene: Probe) -> Decision | None:
    if not p.refractory_us:
        return None
    share = p.refractory_us * 1e-6 / _interval_s(p, scene)
    late_us = _run_events(p, scene) * p.refractory_us
    bound = "stamps in a run, and events lost"
    return Decision("refractory period", True, bound, late_us, share, {"refractory_us": 0.0})


def _noise(p: SensorParameters, scene: Probe) -> Decision | None:
    if not p.noise.rms:
        return None
    ratio = _threshold(p) / p.noise.rms
    # First passage with a reset of one threshold, both signs: 7 % good for a = 3 to 4.5.
    rate_hz = 2 * 1.8 * math.sqrt(2 * math.pi) * ratio * math.exp(-(ratio**2) / 2) * p.noise.corner_hz
    share = _over(rate_hz * _threshold(p), scene)
    jitter_us = _over(p.noise.rms, scene) * 1e6
    off = {"noise": dataclasses.replace(p.noise, rms=0.0)}
    return Decision("noise", True, "jitter of events, and noise events", jitter_us, share, off)


def _jitter(p: SensorParameters) -> Decision | None:
    j = p.jitter
    if not (j.latency_us or j.leak_share):
        return None
    late_us = j.latency_us + 2 * j.deviation_us
    off = {"jitter": dataclasses.replace(j, latency_us=0.0, deviation_us=0.0, leak_share=0.0)}
    return Decision("jitter", True, "latency and two deviations", late_us, None, off)


def _hot_pixels(p: SensorParameters, scene: Probe) -> Decision | None:
    count = p.defects.hot_share * p.width * p.height + len(p.defects.hot_pixels)
    if not count:
        return None
    share = count * p.defects.hot_hz / max(scene.events_per_s, 1e-9)
    off = dataclasses.replace(p.defects, hot_share=0.0, hot_pixels=())
    return Decision("hot pixels", True, "their share of the stream", None, share, {"defects": off})


def _radiation(p: SensorParameters, scene: Probe) -> Decision | None:
    r = p.radiation
    if not r.hits_per_cm2_s:
        return None
    area_cm2 = p.width * p.height * (r.pixel_pitch_um * 1e-4) ** 2
    pixels = 1 + 2 * r.depth_um / r.pixel_pitch_um  # mean length of an isotropic track, and the pixel it begins in
    share = r.hits_per_cm2_s * area_cm2 * pixels * (1 + r.off_share) / max(scene.events_per_s, 1e-9)
    off = dataclasses.replace(r, hits_per_cm2_s=0.0)
    return Decision("radiation", True, "its share of the stream", None, share, {"radiation": off})


def _threshold(p: SensorParameters) -> float:
    return (p.threshold_on + p.threshold_off) / 2


def _over(amount: float, scene: Probe) -> float:
    """Return `amount` over the contrast rate; infinite in a still scene, where every effect is all there is."""
    return amount / scene.contrast_rate if scene.contrast_rate > 0 else math.inf


def _interval_s(p: SensorParameters, scene: Probe) -> float:
    """Time between two events of a pixel, s."""
    return _over(_threshold(p), scene)


def _run_events(p: SensorParameters, scene: Probe) -> float:
    """Events of a monotone run from the darkest to the brightest of the active light; at least one."""
    if not (math.isfinite(scene.least_current) and scene.least_current > 0):
        return 1.0
    return max(1.0, math.log(scene.largest_current / scene.least_current) / _threshold(p))
