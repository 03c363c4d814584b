"""A decision about one effect, and the quantities from which costs of effects are computed (see `decide`)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from emulator.plan.scene_probe import Probe
from emulator.sensor.presets import SensorParameters

__all__ = ["Decision", "Tolerance", "interval_s", "least_current", "over", "run_events", "tau_us", "threshold"]


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
    bound
        The compared quantity, in words.
    cost_us, cost_share
        Error accepted or avoided: of timestamps, us, and as a share of the events; None where it has none.
    changes
        Changes in SensorParameters that drop the effect; for a table, the changes in it.
    choice
        False for an effect that cannot be left out, which is kept at any cost, and for one that the method does not
        have, which is left out.
    kept
        The verdict.
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
