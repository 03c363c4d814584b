"""Parameters of a scene, measured from a few of its frames before the run.

At some instants of the run three frames in a row are drawn. The log light of some 4096 pixels gives the parameters on
which all bounds are based. Means are weighted by the events that each pixel is about to have, that is by its change D
of log light, because errors are errors of events.

    contrast rate A     mean of |D| / h                    per second
    bend C              mean of |u''| / |u'|               per second; a straight line misses C dt^2 / 12
    fourth E4           mean of |u''''| / |u'| dt^4 term   through the Hermite estimate of `step_control`
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from emulator.light import LightFrame, Scene
from emulator.plan.step_control import Sampled, error_us, sample, slips, weighted_quantile
from emulator.sensor.chip.defects import at_temperature
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Floats

_INSTANTS = 8
_FASTEST_CORNER_SHARE = 0.95


@dataclass(frozen=True)
class Probe:
    """Parameters of a scene.

    Attributes
    ----------
    contrast_rate : A, 1/s.
    bend : C, 1/s.
    line_error_us, hermite_error_us : 95th percentile of the timestamp error at a step of `step_s`, us.
    step_s : the step of the probe, s.
    active_share : share of the pixels whose light changes by more than a hundredth of a threshold in a second.
    least_current, largest_current : photocurrent of the active pixels, relative, 5th and 95th percentile over events.
    fastest_change : largest |D| / h of any pixel, 1/s.
    events_per_s : predicted, without refractory period or noise.
    motion_px_s : the scene's bound on image motion.
    line_slips, hermite_slips : slips per event at a step of `step_s`; see `step_control`.
    mean_current : mean photocurrent of all pixels, relative.
    """

    contrast_rate: float
    bend: float
    line_error_us: float
    hermite_error_us: float
    step_s: float
    active_share: float
    least_current: float
    largest_current: float
    fastest_change: float
    events_per_s: float
    motion_px_s: float
    line_slips: float = 0.0
    hermite_slips: float = 0.0
    mean_current: float = 0.0


def probe(scene: Scene, sensor: SensorParameters, step_ns: int, duration_s: float) -> Probe:
    """Return the parameters of a scene, from some instants of a run of `duration_s` with steps of `step_ns`."""
    sensor = at_temperature(sensor)
    instants_ns = [round((k + 0.5) / _INSTANTS * duration_s * 1e9) for k in range(_INSTANTS)]
    triples = [[_look(scene, sensor, t_ns + k * step_ns) for k in range(3)] for t_ns in instants_ns]
    return _figures(scene, sensor, triples)


def _look(scene: Scene, sensor: SensorParameters, t_ns: int) -> Sampled:
    width, height = scene.size
    light, rate = np.zeros((2, height, width), np.float32)
    scene.light_and_rate(t_ns, light, rate)
    return sample(LightFrame(t_ns, light, rate if scene.has_rate else None), sensor.dark_current_relative)


def _figures(scene: Scene, sensor: SensorParameters, triples: list[list[Sampled]]) -> Probe:
    h = (triples[0][1].t_ns - triples[0][0].t_ns) * 1e-9
    change = np.concatenate([after.u - middle.u for _, middle, after in triples])
    current = np.exp(np.concatenate([middle.u for _, middle, _ in triples]))
    change = np.where(np.isfinite(change), change, 0.0)
    weight = np.abs(change)
    total = float(weight.sum())
    threshold = (sensor.threshold_on + sensor.threshold_off) / 2
    without = [[Sampled(s.u, None, s.t_ns) for s in triple] for triple in triples]  # their slopes
    line = _errors(without)
    line_mean_us = float((line[0] * line[1]).sum()) / total if total else 0.0
    return Probe(
        contrast_rate=float((weight**2).sum()) / total / h if total else 0.0,
        bend=12 * line_mean_us * 1e-6 / h**2,
        line_error_us=weighted_quantile(*line, 0.95),
        hermite_error_us=weighted_quantile(*_errors(triples), 0.95),
        step_s=h,
        active_share=float(np.mean(weight / h > 0.01 * threshold)),
        least_current=weighted_quantile(current, weight, 1 - _FASTEST_CORNER_SHARE) if total else math.nan,
        largest_current=weighted_quantile(current, weight, _FASTEST_CORNER_SHARE) if total else math.nan,
        fastest_change=float(weight.max()) / h,
        events_per_s=float(weight.mean()) / h / threshold * sensor.width * sensor.height,
        motion_px_s=scene.motion_bound_px_s,
        line_slips=_slips(without),
        hermite_slips=_slips(triples),
        mean_current=float(current[np.isfinite(current)].mean()) if np.isfinite(current).any() else 0.0,
    )


def _slips(triples: list[list[Sampled]]) -> float:
    missed, events = (sum(column) for column in zip(*(slips(*triple) for triple in triples), strict=True))
    return missed / events if events else 0.0


def _errors(triples: list[list[Sampled]]) -> tuple[Floats, Floats]:
    pairs = [error_us(*triple) for triple in triples]
    return np.concatenate([e for e, _ in pairs]), np.concatenate([w for _, w in pairs])
