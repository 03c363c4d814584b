"""Decisions about effects: which ones may be left out of a model, and the bound that decides.

A is the scene's contrast rate, C its bend (see `scene_probe`), theta the threshold, T the run's length, N = A T / theta
the events that an active pixel raises, n the events of one monotone run, eps the tolerated timestamp error, delta the
tolerated share of wrong events, dim the share of dark current in the darkest active light.

    effect              what dropping it costs                             dropped when
    low-pass            every stamp early by tau                           the longest tau < eps
    bandwidth           lags differ by those of darkest and brightest      that < eps
    large signals       stamps early by (1 + ln range) / (2 pi f_max)      that < eps; off unless asked for
    source follower     every stamp early by 1/lambda2                     1/lambda2 < eps
    leak                R T events a pixel; stamps drift by R theta T/A    R T < delta N, and the drift < eps
    its spread, jitter  the same, of the rate's deviation                  the same
    parasitic           the same, R proportional to light                  the same
    mismatch            stamps off by n sigma theta / A                    that < eps
    refractory          t_ref A/theta of the events; stamps by n t_ref     that < delta, and n t_ref < eps
    noise               R events a second; stamps off by rms / A           R < delta A/theta, and rms / A < eps
    shift by noise      stamps late by up to 3 rms / A                     that < eps, and a point process will do
    jitter              stamps early by the latency                        latency + 2 deviations < eps
    dark current        contrasts larger by dim                            never: it is the floor of the logarithm
    temperature         its changes of leak and dark current               as these
    efficiencies, PRNU  contrasts by change dim, stamps by change tau      that < delta, and < eps
    DCNU                the same, of dark current                          the same
    shot noise          stamps off by s / A, events where s is large       these < eps, < delta
    hot pixels          their events                                       less than delta of the stream
    dead pixels         their events                                       less than delta of the pixels
    radiation, dose     its events                                         less than delta of the stream

Mismatch and leak soon change the sequences of events: they are dropped only where the run tolerates that. Effects that
the rig has switched off are not modelled and have no bound.
"""

from __future__ import annotations

import dataclasses

from emulator.plan.chip_costs import chip_costs
from emulator.plan.decision import Decision, Tolerance
from emulator.plan.pixel_costs import pixel_costs
from emulator.plan.scene_probe import Probe
from emulator.sensor.presets import SensorParameters

__all__ = ["Decision", "Tolerance", "decide", "without"]


def decide(sensor: SensorParameters, scene: Probe, tolerance: Tolerance) -> list[Decision]:
    """Return a decision for each effect that `sensor` has switched on."""
    costs = [*pixel_costs(sensor, scene, tolerance), *chip_costs(sensor, scene, tolerance)]
    return [_judge(cost, tolerance) for cost in costs if cost is not None]


def without(sensor: SensorParameters, decisions: list[Decision]) -> SensorParameters:
    """Return `sensor` without the effects that were dropped."""
    for decision in decisions:
        if not decision.kept:
            for name, value in decision.changes.items():
                table = isinstance(value, dict)
                sensor = dataclasses.replace(
                    sensor, **{name: dataclasses.replace(getattr(sensor, name), **value) if table else value}
                )
    return sensor


def _judge(cost: Decision, tolerance: Tolerance) -> Decision:
    if not cost.choice:
        return cost
    too_late = cost.cost_us is not None and not cost.cost_us < tolerance.eps_us
    too_many = cost.cost_share is not None and not cost.cost_share < tolerance.wrong_share
    return dataclasses.replace(cost, kept=too_late or too_many)
