"""What each effect of the sensor costs and changes when it is switched on alone.

The ideal pixel has equal thresholds, no leak, no low-pass and no refractory period. Each effect is added to it with the
figures of the sensor in question, and the events are compared with those of the ideal pixel under the same light: the
count, the share of pixels whose sequence stays, and by how much their events move.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from emulator.accuracy.harness import Case, Method, events, step_cost_us
from emulator.accuracy.metrics import Scores, compare
from emulator.sensor.presets import SensorParameters

__all__ = ["EFFECTS", "Effect", "EffectRow", "effect_rows"]

_IDEAL: dict[str, Any] = {
    "mismatch": 0.0,
    "leak_hz": 0.0,
    "parasitic_hz_at_reference": 0.0,
    "corner_hz_at_reference": math.inf,
    "source_follower_hz": 0.0,
    "refractory_us": 0.0,
}


@dataclass(frozen=True)
class Effect:
    """An effect and the parameters that switch it on."""

    name: str
    fields: tuple[str, ...]
    instead: tuple[tuple[str, float], ...] = ()  # figures to take where the sensor has the effect switched off


EFFECTS = (
    Effect("none: the ideal pixel", ()),
    Effect("threshold mismatch", ("mismatch",)),
    Effect("junction leak", ("leak_hz", "leak_spread")),
    Effect("parasitic leak", ("parasitic_hz_at_reference",), (("parasitic_hz_at_reference", 0.1),)),
    Effect("low-pass, following the light", ("corner_hz_at_reference", "corner_min_hz", "corner_max_hz")),
    Effect("second pole", ("source_follower_hz",), (("source_follower_hz", 300.0),)),
    Effect("refractory period", ("refractory_us",), (("refractory_us", 100.0),)),
    Effect("all of them", tuple(_IDEAL), (("refractory_us", 100.0),)),
)
"""In the order of the table."""


@dataclass(frozen=True)
class EffectRow:
    """An effect alone: what it is set to, the time of a step with it (us, 346 x 260), and the change of the events."""

    name: str
    setting: str
    us_per_frame: float
    scores: Scores


def _switched_on(effect: Effect, parameters: SensorParameters) -> dict[str, Any]:
    own = {name: getattr(parameters, name) for name in effect.fields}
    return own | {name: value for name, value in effect.instead if not own[name]}


def effect_rows(method: Method, case: Case, step_s: float) -> Iterator[EffectRow]:
    """Yield each effect's row for a method on a case, the ideal pixel first."""
    ideal = dataclasses.replace(case, parameters=dataclasses.replace(case.parameters, **_IDEAL))
    plain, _ = events(method, ideal, step_s)
    for effect in EFFECTS:
        on = _switched_on(effect, case.parameters)
        alone = dataclasses.replace(ideal, parameters=dataclasses.replace(ideal.parameters, **on))
        stream, _ = events(method, alone, step_s)
        told = ", ".join(f"{name} = {value:g}" for name, value in on.items()) if len(on) <= 3 else "as above"
        yield EffectRow(effect.name, told, step_cost_us(method, alone, step_s), compare(stream, plain))
