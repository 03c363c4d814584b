"""Test harness of pixel methods: run a method on known light, score it against the truth, and time it.

A case is a row of pixels under closed-form light, with a sensor. Methods:

    hermite   our own kernel, given the light and its time derivative
    refined   the same, given the light of single pixels between the frames too: it refines undersampled steps
    line      the same kernel without derivatives: a straight line in log light
    pangu     PANGU's rule, which cannot be run as it is

All get the same float32 frames at the same times, with the same thresholds, leak rates and phases. Time is measured
on a sensor of 346 x 260 pixels, whose light frame repeats the case's row: the median of some steps, the method's
`step` alone.

`CASES` are the scenes of the chart, each with its sensor and the steps of its sweep. They are those of the tables by
which the method was chosen: threshold 0.2 with 3 % mismatch, leak 0.1 Hz with 30 % spread, contrast 10 : 1, corner
frequency 300 Hz at light 1 and proportional to light between 1 and 3000 Hz, 60 pixels, 0.4 s.

Cases with noise have equal pixels in the same light, which are samples of one distribution. Their truth is that of
`laboratory.methods.grid`, and only evstim's own pixels have noise.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from emulator.light import LightFrame, PixelLight
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.crossings import Crossings
from emulator.sensor.pixels.method import MakePixels
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Float32s, Int64s
from laboratory.accuracy.peers.pangu import Pangu
from laboratory.accuracy.scenes import (
    BlurredCheckerboard,
    ClosedLight,
    Dark,
    DriftingStar,
    Flash,
    Flicker,
    LogSine,
    MovingEdge,
    ShadedEdge,
    SineGrating,
    SlowRamp,
    TexturedDisc,
    ThinLine,
    TurningBody,
)
from laboratory.accuracy.scores import Scores, Stream, compare, compare_samples
from laboratory.accuracy.truth import true_events
from laboratory.methods.grid import NoisyPixels

SEED = 3
"""Fixes mismatch, leak rates and phases of every case."""

_COST_SIZE = 346, 260
_COST_STEPS = 9
_COST_WARM_UP = 2
_COST_BUDGET_S = 0.15  # no more steps are timed once these took so long


@dataclass(frozen=True)
class Method:
    """A method that makes events from frames.

    Attributes
    ----------
    name : as above; of evstim's own as in a rig's `run.method`.
    make : factory, for a sensor and a seed.
    rate : True: the method gets the light's time derivative.
    refines : True: the method gets the light of single pixels between the frames.
    """

    name: str
    make: MakePixels
    rate: bool = False
    refines: bool = False


@dataclass(frozen=True)
class Case:
    """Known light, a sensor of one row, and a duration.

    Attributes
    ----------
    name : one word.
    scene : the light, with as many pixels as the sensor.
    parameters : the sensor.
    duration_s : length in stream time.
    start_ns : stream time of the start; the light counts time from the start.
    fine_s : step of the truth, s; longer for slow scenes. With noise: between two frames of the reference.
    """

    name: str
    scene: ClosedLight
    parameters: SensorParameters
    duration_s: float = 0.4
    start_ns: int = 0
    fine_s: float = 1e-5


REFERENCE = Method("reference", NoisyPixels, rate=True)
"""The reference of cases with noise."""


def methods() -> list[Method]:
    """Return all methods, our own first."""
    refined = Method("refined", PixelArray, rate=True, refines=True)
    return [Method("hermite", PixelArray, rate=True), refined, Method("line", PixelArray), Method("pangu", Pangu)]


@lru_cache(maxsize=64)
def truth(case: Case) -> Stream:
    """Return the true events of a case, times counted from its start; with noise a sample of them."""
    if case.parameters.noise.rms:
        return events(REFERENCE, case, case.fine_s)[0]
    return true_events(case.scene, case.parameters, SEED, case.duration_s, case.fine_s)


def events(
    method: Method, case: Case, step_s: float, seen: Callable[[Float32s], Float32s] | None = None
) -> tuple[Stream, int]:
    """Run a method over a case; return its events, times counted from the start, and the number it lost in pixels.

    Parameters
    ----------
    step_s : time between frames, s; rounded to ns. A case should last a whole number of steps: the truth ends with it.
    seen : change of each frame before the method gets it.
    """
    array, h_ns = method.make(case.parameters, SEED), round(step_s * 1e9)
    steps = round(case.duration_s * 1e9 / h_ns)
    t_s = np.arange(steps + 1) * (h_ns * 1e-9)
    at = pixel_light(case.scene, case.start_ns) if method.refines else None
    light, slope = (one.astype(np.float32)[:, None, :] for one in case.scene.light_and_rate(t_s))
    rate = slope if method.rate else None
    light = light if seen is None else seen(light)
    found: list[Crossings] = []
    array.reset(LightFrame(case.start_ns, light[0], None if rate is None else rate[0]))
    for k in range(1, steps + 1):
        crossings = array.step(LightFrame(case.start_ns + k * h_ns, light[k], None if rate is None else rate[k], at))
        found.append(Crossings(crossings.t_ns.copy(), crossings.pixel.copy(), crossings.on.copy()))
    t_ns, pixel, on = (np.concatenate([getattr(c, field) for c in found]) for field in ("t_ns", "pixel", "on"))
    return Stream.of((t_ns - case.start_ns) * 1e-3, pixel, on, case.scene.pixels), array.lost_in_pixel


def pixel_light(scene: ClosedLight, start_ns: int = 0) -> PixelLight:
    """Return the source of the light of single pixels from `start_ns` on; a wider frame repeats the row."""

    def at(t_ns: int, pixels: Int64s) -> tuple[Float32s, Float32s]:
        light, rate = scene.light_and_rate((t_ns - start_ns) * 1e-9)
        places = pixels % scene.pixels
        return light[0, places].astype(np.float32), rate[0, places].astype(np.float32)

    return at


def score(method: Method, case: Case, step_s: float) -> Scores:
    """Return the scores of a method on a case in steps of `step_s`, as of samples where there is noise."""
    compared = compare_samples if case.parameters.noise.rms else compare
    return compared(events(method, case, step_s)[0], truth(case))


def step_cost_us(method: Method, case: Case, step_s: float) -> float:
    """Return the median time of a step on 346 x 260 pixels, us, in the middle of the case."""
    width, height = _COST_SIZE
    h_ns = round(step_s * 1e9)
    steps = min(_COST_WARM_UP + _COST_STEPS, max(3, round(case.duration_s * 1e9) // h_ns))
    first = max(0, round(case.duration_s * 1e9) // h_ns - steps) // 2
    t_s = (first + np.arange(steps + 1)) * (h_ns * 1e-9)
    light, slopes = ([np.resize(row.astype(np.float32), (height, width)) for row in one]
                     for one in case.scene.light_and_rate(t_s))  # fmt: skip
    rate = slopes if method.rate else [None] * len(light)
    array = method.make(dataclasses.replace(case.parameters, width=width, height=height), SEED)
    at = pixel_light(case.scene) if method.refines else None
    array.reset(LightFrame(0, light[0], rate[0]))
    frames = [LightFrame(k * h_ns, light[k], rate[k], at) for k in range(1, steps + 1)]
    taken_s: list[float] = []
    for frame in frames:
        begun_s = time.perf_counter()
        array.step(frame)
        taken_s.append(time.perf_counter() - begun_s)
        if len(taken_s) > _COST_WARM_UP and sum(taken_s) > _COST_BUDGET_S:
            break
    return statistics.median(taken_s[min(_COST_WARM_UP, len(taken_s) - 1) :]) * 1e6


PLAIN = SensorParameters(
    width=60,
    height=1,
    threshold_on=0.2,
    threshold_off=0.2,
    mismatch=0.03,
    dark_current_relative=1e-4,
    corner_hz_at_reference=300.0,
    corner_min_hz=1.0,
    corner_max_hz=3000.0,
    leak_hz=0.1,
    leak_spread=0.3,
)
"""The sensor of the tables, one row."""


@dataclass(frozen=True)
class Swept:
    """A case, its description in a few words, and its steps, ms."""

    case: Case
    description: str
    steps_ms: tuple[float, ...]

    @property
    def has_noise(self) -> bool:
        """True: streams are samples of a distribution, and compared as such."""
        return self.case.parameters.noise.rms > 0

    def fitting(self, ways: Sequence[Method]) -> list[Method]:
        """Return the methods that have the effects of the case."""
        return [method for method in ways if method.make is PixelArray or not self.has_noise]


_NOISY = dataclasses.replace(
    PLAIN, mismatch=0.0, leak_hz=0.0, corner_hz_at_reference=3000.0, refractory_us=20.0,
    noise=NoiseParameters(rms=0.045, corner_hz=1900.0),
)  # fmt: skip


def _noisy(name: str, scene: LogSine, description: str, **changes: Any) -> Swept:
    """Return a case with noise, its highest corner frequency that of the light, which the reference's steps follow."""
    p = dataclasses.replace(_NOISY, corner_max_hz=5000.0 * scene.level, **changes)
    case = Case(name, dataclasses.replace(scene, spread=0.0), p, 4.0, fine_s=1e-3)
    return Swept(case, f"noise, {description}: distributions", (0.2, 1.0, 5.0, 10.0, 20.0, 80.0))


_FAST = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_SLOW = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)

CASES = (
    Swept(
        Case("sine", SineGrating(), dataclasses.replace(PLAIN, corner_hz_at_reference=200.0)),
        "sine grating, 5.7 : 1, 20 Hz",
        _FAST,
    ),
    Swept(Case("edge03", MovingEdge(sigma_px=0.3), PLAIN), "edge of 0.3 px, 100 px/s", _FAST),
    Swept(Case("edge1", MovingEdge(sigma_px=1.0), PLAIN), "edge of 1 px, 100 px/s", _FAST),
    Swept(Case("checkerboard", BlurredCheckerboard(), PLAIN), "checkerboard, 0.5 px blur, 100 px/s", _FAST),
    Swept(Case("disc", TexturedDisc(), PLAIN), "textured disc, 1 rad/s", (*_FAST[2:], 20.0)),
    Swept(Case("star", DriftingStar(), PLAIN), "star 200 : 1, 17 px/s", (*_FAST[2:], 20.0)),
    Swept(Case("flicker", Flicker(), PLAIN), "flicker of 50 % at 100 Hz", (0.05, *_FAST[:5])),
    Swept(Case("flash", Flash(), PLAIN, 0.1), "flash 100 : 1 at an unknown instant", _FAST),
    Swept(
        Case("lowlight", SineGrating(hz=2.0, mean=0.0525, modulation=0.905), PLAIN, 1.0),
        "low light: 2 Hz sine, corner 1.5 to 30 Hz",
        _SLOW,
    ),
    Swept(Case("ramp", SlowRamp(), PLAIN, 2.0), "slow ramps, 0.3 to 3 ln units a second", _SLOW),
    Swept(Case("kinked", ShadedEdge(), PLAIN, 0.35), "kinked edge of 0.6 px, shaded, 100 px/s", _FAST),
    Swept(Case("line", ThinLine(profile="blurred"), PLAIN, 0.35), "line of 1 px, 0.6 px blur, 100 px/s", _FAST),
    Swept(Case("body", TurningBody(), PLAIN, 0.6), "turning body, 6 : 1, 100 px/s", _FAST),
    _noisy("noise_still", LogSine(amplitude=0.0, level=0.1), "still light of 0.1", noise=NoiseParameters(0.07, 1900.0)),
    _noisy("noise_dim", LogSine(level=0.1), "2 Hz sine about 0.1"),
    _noisy("noise_bright", LogSine(), "2 Hz sine about 1"),
    Swept(Case("dark", Dark(), dataclasses.replace(PLAIN, leak_hz=2.0), 2.0), "dark: leak alone, 2 Hz", _SLOW),
)
"""All scenes of the chart."""

QUICK = tuple(
    Swept(swept.case, swept.description, (0.5, 2.0, 5.0))
    for swept in CASES
    if swept.case.name in ("sine", "checkerboard", "disc", "noise_dim")
)
"""Four scenes in three steps."""
