"""Cost and effect on the events of each effect of the sensor, switched on alone.

The ideal sensor has equal thresholds, no leak, no low-pass, no refractory period, no noise and no fault. Each effect is
added to it, with the figures of the case's sensor or, where that has it switched off, with those of the table; the
events that leave the sensor are compared with those of the ideal one under the same light: the count, the share of
pixels whose sequence stays, and by how much their events move. The time is that of a whole step of the sensor on
346 x 260 pixels, read-out included.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from emulator.accuracy.harness import SEED, Case
from emulator.accuracy.metrics import Scores, compare
from emulator.accuracy.stream import Stream
from emulator.sensor.presets import ReadoutParameters, SensorParameters
from emulator.sensor.sensor import Sensor

__all__ = ["EFFECTS", "QUICK_EFFECTS", "Effect", "EffectRow", "effect_rows"]

_IDEAL: dict[str, Any] = {
    "mismatch": 0.0,
    "leak_hz": 0.0,
    "parasitic_hz_at_reference": 0.0,
    "corner_hz_at_reference": math.inf,
    "source_follower_hz": 0.0,
    "refractory_us": 0.0,
    "readout": ReadoutParameters(event_ns=1.0, row_ns=0),
}
_SIZE = 346, 260
_STEPS = 15
_WARM_UP = 4
_BUDGET_S = 0.3  # no more steps are timed once these took so long


@dataclass(frozen=True)
class Effect:
    """An effect, and the fields that switch it on.

    Attributes
    ----------
    own : tuple of str
        Fields that are copied from the case's sensor.
    table : str
        Table of the sensor in which `instead` is set.
    instead : tuple
        Fields and their values where the case's sensor has the effect switched off.
    """

    name: str
    own: tuple[str, ...] = ()
    table: str = ""
    instead: tuple[tuple[str, Any], ...] = ()


EFFECTS = (
    Effect("none: the ideal sensor"),
    Effect("threshold mismatch", ("mismatch",), instead=(("mismatch", 0.03),)),
    Effect("junction leak", ("leak_hz", "leak_spread"), instead=(("leak_hz", 0.1),)),
    Effect("parasitic leak", instead=(("parasitic_hz_at_reference", 0.1),)),
    Effect("low-pass, following the light", ("corner_hz_at_reference", "corner_min_hz", "corner_max_hz")),
    Effect("second pole", instead=(("source_follower_hz", 300.0),)),
    Effect("refractory period", instead=(("refractory_us", 100.0),)),
    Effect("noise as a point process", table="noise", instead=(("rms", 0.05), ("corner_hz", 300.0))),
    Effect("noise on a grid", table="noise", instead=(("rms", 0.05), ("corner_hz", 300.0), ("grade", "grid"))),
    Effect("event-time jitter", table="jitter", instead=(("latency_us", 100.0), ("deviation_us", 30.0))),
    Effect("hot pixels", table="defects", instead=(("hot_share", 0.05),)),
    Effect("dead pixels", table="defects", instead=(("dead_share", 0.05),)),
    Effect("photo-response non-uniformity", table="imager", instead=(("prnu", 0.02),)),
    Effect("photon shot noise", table="imager", instead=(("photon_shot_noise", True),)),
    Effect("particles, 1000 a cm2 and s", table="radiation", instead=(("hits_per_cm2_s", 1000.0),)),
    Effect("read-out of 80 ns an event", table="readout", instead=(("event_ns", 80.0), ("row_ns", 80))),
)
"""All effects, in the order of the table."""

QUICK_EFFECTS = tuple(effect for effect in EFFECTS if ("grade", "grid") not in effect.instead)
"""The effects whose step takes less than a second."""


@dataclass(frozen=True)
class EffectRow:
    """An effect alone: what it is set to, the time of a step with it (us, 346 x 260), and the change of the events."""

    name: str
    setting: str
    us_per_frame: float
    scores: Scores


def _changes(effect: Effect, own: SensorParameters) -> dict[str, Any]:
    """Return the fields that switch an effect on."""
    if effect.table:
        return {effect.table: dataclasses.replace(getattr(own, effect.table), **dict(effect.instead))}
    own_values = {name: getattr(own, name) for name in effect.own}
    return own_values | {name: value for name, value in effect.instead if not own_values.get(name)}


def _told(effect: Effect, changes: dict[str, Any]) -> str:
    shown = dict(effect.instead) if effect.table else changes
    return ", ".join(f"{k} = {v:g}" if isinstance(v, float) else f"{k} = {v}" for k, v in shown.items())


def _run(case: Case, parameters: SensorParameters, step_s: float) -> Stream:
    """Return the events of a sensor of one row under the light of a case."""
    sensor, h_ns = Sensor(parameters, SEED), round(step_s * 1e9)
    t_s = np.arange(round(case.duration_s / step_s) + 1) * step_s
    light, rate = (f(t_s).astype(np.float32)[:, None, :] for f in (case.scene.value, case.scene.rate))
    sensor.reset(light[0], 0)
    parts = [sensor.expose(light[k], k * h_ns, rate[k]) for k in range(1, t_s.size)]
    return Stream.from_events(np.concatenate([*parts, sensor.finish()]), parameters.width, parameters.height)


def _cost_us(case: Case, parameters: SensorParameters, step_s: float) -> float:
    """Return the median time of a step of a whole sensor, us."""
    width, height = _SIZE
    sensor = Sensor(dataclasses.replace(parameters, width=width, height=height), SEED)
    t_s = case.duration_s / 2 + np.arange(_STEPS + 1) * step_s
    light, rate = (
        [np.resize(row.astype(np.float32), (height, width)) for row in f(t_s)]
        for f in (case.scene.value, case.scene.rate)
    )
    sensor.reset(light[0], 0)
    taken = []
    for k in range(1, _STEPS + 1):
        begun = time.perf_counter()
        sensor.expose(light[k], k * round(step_s * 1e9), rate[k])
        taken.append(time.perf_counter() - begun)
        if sum(taken) > _BUDGET_S:
            break
    return statistics.median(taken[min(_WARM_UP, len(taken) - 1) :]) * 1e6


def effect_rows(case: Case, step_s: float, effects: Sequence[Effect] = EFFECTS) -> Iterator[EffectRow]:
    """Yield each effect's row on a case."""
    ideal = dataclasses.replace(case.parameters, **_IDEAL)
    plain = _run(case, ideal, step_s)
    for effect in effects:
        changes = _changes(effect, case.parameters)
        alone = dataclasses.replace(ideal, **changes)
        scores = compare(_run(case, alone, step_s), plain)
        yield EffectRow(effect.name, _told(effect, changes), _cost_us(case, alone, step_s), scores)
