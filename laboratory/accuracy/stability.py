"""Limits of each method: one quantity at a time goes from harmless to extreme, and every method is scored.

    dt_over_tau     step over the filter's time constant; fixed corner, 0.3 thresholds a step
    contrast        largest change of log light in a step, in thresholds; step = time constant
    refractory      refractory period over step; checkerboard at 0.25 px a step
    motion          pixels of motion in a step; checkerboard blurred by 0.5 px, steps of 5 ms
    darkness        level of light, down to nothing but the sensor's dark current (1e-4)
    stream_time     hours of stream before the scene begins
    burst           events of one pixel in one step: a flash, ever brighter
    bit_depth       bits of the frame that the method gets, linear from 0 to the brightest; 0 stands for float

A row of 40 pixels; the boundaries are those of right sequences falling below 95 %.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any

import numpy as np

from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Float32s
from laboratory.accuracy.harness import PLAIN, Case, Method, events, truth
from laboratory.accuracy.scenes import BlurredCheckerboard, Flash, SineGrating
from laboratory.accuracy.scores import compare

_PIXELS = 40
_MODULATION = 0.7
_STEEPEST = 2 * math.pi * _MODULATION / math.sqrt(1 - _MODULATION**2)
"""Steepest slope of the sine's log light, ln units a period."""


@dataclass(frozen=True)
class Setting:
    """A case, the step, and a change of each frame before the method gets it."""

    case: Case
    step_s: float
    seen: Callable[[Float32s], Float32s] | None = None


@dataclass(frozen=True)
class Sweep:
    """One axis of the map.

    Attributes
    ----------
    axis : name of the axis.
    description : a few words.
    label : of the axis, with the unit.
    values : from harmless to extreme.
    at : returns the setting of a value.
    """

    axis: str
    description: str
    label: str
    values: tuple[float, ...]
    at: Callable[[float], Setting]


@dataclass(frozen=True)
class Cell:
    """A method at one value of an axis.

    Attributes
    ----------
    right, count, wrong_events : see `scores`.
    t50_steps, t95_steps : timestamp error over the step.
    lost : crossings beyond the most of one pixel and step.
    """

    axis: str
    value: float
    method: str
    right: float
    t50_steps: float
    t95_steps: float
    count: float
    wrong_events: float
    lost: int


def _sensor(**changes: Any) -> SensorParameters:
    return dataclasses.replace(PLAIN, width=_PIXELS, **changes)


def _fixed_corner(hz: float) -> dict[str, float]:
    return {"corner_hz_at_reference": hz, "corner_min_hz": hz, "corner_max_hz": hz}


def smooth_case(contrast: float, dt_over_tau: float, step_s: float = 1e-3) -> Case:
    """Return a sine whose log light changes by `contrast` thresholds a step at most, through a fixed low-pass."""
    hz = contrast * PLAIN.threshold_on / (_STEEPEST * step_s)
    corner = dt_over_tau / (2 * math.pi * step_s)
    scene = SineGrating(pixels=_PIXELS, hz=hz, modulation=_MODULATION)
    duration_s = step_s * min(max(math.ceil(2.5 / (hz * step_s)), 40), 400)
    return Case("smooth", scene, _sensor(**_fixed_corner(corner)), duration_s, fine_s=step_s / 100)


def _dt_over_tau(value: float) -> Setting:
    return Setting(smooth_case(0.3, value), 1e-3)


def _contrast(value: float) -> Setting:
    return Setting(smooth_case(value, 1.0), 1e-3)


def _refractory(value: float) -> Setting:
    board = BlurredCheckerboard(pixels=_PIXELS)
    return Setting(Case("refractory", board, _sensor(refractory_us=2500 * value), 0.3), 2.5e-3)


def _motion(value: float) -> Setting:
    board = BlurredCheckerboard(pixels=_PIXELS, speed_px_s=value / 5e-3)
    return Setting(Case("motion", board, _sensor(), 0.2), 5e-3)


def _darkness(value: float) -> Setting:
    dim = SineGrating(pixels=_PIXELS, mean=value, hz=5.0)
    return Setting(Case("darkness", dim, _sensor(leak_hz=5.0), 0.5), 1e-3)


def _stream_time(value: float) -> Setting:
    scene = SineGrating(pixels=_PIXELS)
    return Setting(Case("stream_time", scene, _sensor(), 0.2, start_ns=round(value * 3600e9)), 5e-4)


def _burst(value: float) -> Setting:
    """A flash of `value` thresholds, for a sensor with a dark current low enough for it."""
    dark = 1e-8
    scene = Flash(pixels=_PIXELS, dark=0.0, bright=dark * math.expm1((value + 0.5) * PLAIN.threshold_on))
    changes = {"dark_current_relative": dark, **_fixed_corner(3000.0), "leak_hz": 0.0, "mismatch": 0.0}
    return Setting(Case("burst", scene, _sensor(**changes), 0.08), 5e-3)


def _bit_depth(value: float) -> Setting:
    board = BlurredCheckerboard(pixels=_PIXELS, speed_px_s=25.0, sigma_px=2.0)

    def quantised(light: Float32s) -> Float32s:
        steps = 2.0**value - 1
        return np.asarray(np.round(light * steps) / steps, np.float32)

    return Setting(Case("bit_depth", board, _sensor(), 0.6), 2e-3, quantised if value else None)


SWEEPS = (
    Sweep("dt_over_tau", "step over time constant", "dt / tau", (0.03, 0.1, 0.3, 1, 3, 10, 30), _dt_over_tau),
    Sweep("contrast", "contrast of a step", "thresholds a step", (0.1, 0.3, 1, 2, 3, 5, 10), _contrast),
    Sweep("refractory", "refractory period", "t_ref / dt", (0, 0.03, 0.1, 0.3, 1, 3, 10), _refractory),
    Sweep("motion", "motion, 0.5 px blur", "px a step", (0.125, 0.25, 0.5, 0.75, 1, 1.5, 2, 4), _motion),
    Sweep("darkness", "light down to zero", "mean light", (1, 0.1, 0.01, 1e-3, 1e-4, 1e-6, 0), _darkness),
    Sweep("stream_time", "hours of stream", "h", (0, 1, 24, 720, 8760, 87600), _stream_time),
    Sweep("burst", "events of a pixel in a step", "events", (5, 20, 40, 60, 80, 120), _burst),
    Sweep("bit_depth", "bits of the input", "bits (0: float)", (0, 16, 12, 10, 8, 6), _bit_depth),
)
"""The axes of the map."""

QUICK_SWEEPS = tuple(
    dataclasses.replace(sweep, values=sweep.values[::2]) for sweep in SWEEPS if sweep.axis in ("contrast", "motion")
)
"""Two axes, every other value."""


def cells(sweeps: Sequence[Sweep], methods: Sequence[Method]) -> Iterator[Cell]:
    """Yield every method at every value of every axis."""
    for sweep in sweeps:
        for value in sweep.values:
            setting = sweep.at(value)
            step_us = setting.step_s * 1e6
            for method in methods:
                stream, lost = events(method, setting.case, setting.step_s, setting.seen)
                scores = compare(stream, truth(setting.case))
                yield Cell(
                    sweep.axis, value, method.name, scores.right, scores.t50_us / step_us, scores.t95_us / step_us,
                    scores.count, scores.wrong_events, lost,
                )  # fmt: skip


def boundary(found: Sequence[Cell], sweep: Sweep, method: str, right: float = 0.95) -> float | None:
    """Return the last value of an axis up to which a method has `right` sequences; None if it never does."""
    shares = {cell.value: cell.right for cell in found if (cell.axis, cell.method) == (sweep.axis, method)}
    held = [*takewhile(lambda value: shares[value] >= right, sweep.values)]
    return held[-1] if held else None
