"""Noise of evstim's pixels beside the reference of `laboratory.methods.grid`, which shares no code with it.

    python -m laboratory.accuracy.noise [CHECK ...] [--scale 1] [--json]

    sines     rates, order and intervals on sines in log light, contrast 0.1 to 2, 0.5 to 10 Hz, light 1 to 0.02
    still     the same in still light, after a reset and after events of a signal, threshold over sigma 1.6 to 7.2
    ramps     mean and spread of the intervals on ramps of 1 to 1000 thresholds a second
    edges     mean and spread of the first event's time at edges of 2 us to 2 ms
    start     rates of presets from 0 to 2 s with 20 s of noise before, beside those after 20 s without
    same      share of the events that are the same with two threads, and after a restart

All checks take half an hour on one core, and `--scale 0.1` a tenth of the pixels. Both sides have the same thresholds
and the same light: the pixels get frames with the time derivative, and light of single pixels between them; the
reference gets frames every millisecond or less. A line has each quantity of the pixels, that of the reference, and the
ratio with its standard error, from 32 groups of pixels; a star marks one off its target by more than two of these.
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
import json as to_json
import math
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from cyclopts import App

from emulator.light import LightFrame
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.crossings import Crossings
from emulator.sensor.pixels.method import MakePixels
from emulator.sensor.presets import PRESETS, SensorParameters
from laboratory.accuracy.harness import Case, Method, events
from laboratory.accuracy.scenes import ClosedLight, Dark, LogEdge, LogSine, SlowRamp
from laboratory.accuracy.scores import Stream
from laboratory.methods.grid import NoisyPixels, grid_ns

THETA, RMS, DARK = 0.223, 0.045, 0.009
STEPS_MS = 0.2, 1.0, 10.0, 80.0
GROUPS = 32

Receptor = Literal["one_pole", "large_signal"]


class Measured(NamedTuple):
    """A quantity of both sides, the standard error of the ratio pixels / reference, and the target of |ratio - 1|."""

    quantity: str
    ours: float
    reference: float
    error: float
    target: float

    @property
    def ratio(self) -> float:
        """The pixels' quantity over that of the reference."""
        return self.ours / self.reference if self.reference else math.nan

    @property
    def is_off(self) -> bool:
        """True: the ratio misses the target by more than two standard errors."""
        return abs(self.ratio - 1) > self.target + 2 * self.error

    def __str__(self) -> str:
        star = "*" if self.is_off else " "
        return f"{self.quantity} {self.ours:.4g} {self.reference:.4g} {self.ratio:.3f} +- {self.error:.3f}{star}"


class Line(NamedTuple):
    """All quantities of one setting."""

    setting: str
    step_ms: float
    measured: list[Measured]

    def __str__(self) -> str:
        return f"{self.setting:45} {self.step_ms:6g} ms  {'  '.join(map(str, self.measured))}"


Quantity = tuple[str, Callable[[Stream], float], float]
"""A name, the function of a stream, and the target."""


def measured(quantities: Iterable[Quantity], ours: Stream, true: Stream) -> list[Measured]:
    """Return quantities of two streams of the same pixels."""
    out = []
    for name, of, target in quantities:
        parts = [[of(one.where(one.pixel % GROUPS == k)) for k in range(GROUPS)] for one in (ours, true)]
        error = np.std(np.subtract(parts[0], parts[1])) / math.sqrt(GROUPS - 1) / (np.mean(parts[1]) or math.nan)
        out.append(Measured(name, of(ours), of(true), float(error), target))
    return out


def behaviour(seconds: float, target: float = 0.03) -> list[Quantity]:
    """Return rate (Hz), share of events before one of the other polarity, and quantiles of the intervals (ms)."""

    def quantile(level: float, stream: Stream) -> float:
        intervals = stream.intervals_us()
        return float(np.quantile(intervals, level)) * 1e-3 if intervals.size else math.nan

    return [
        ("Hz", lambda stream: len(stream) / stream.pixels / seconds, target),
        ("opposite", lambda stream: float(stream.words(2)[1:3].sum()), target),
        *((f"{level:.0%}", partial(quantile, level), target) for level in (0.05, 0.5, 0.95)),
    ]


def sensor(light: float, poles: int, receptor: Receptor, pixels: int, **changes: Any) -> SensorParameters:
    """Return a sensor like an imx636, its highest corner frequency that of `light`, which the grid's step follows."""
    p = SensorParameters(
        width=pixels, height=1, threshold_on=THETA, threshold_off=THETA, dark_current_relative=DARK, leak_hz=0.0,
        corner_max_hz=3000.0 * (light + DARK), source_follower_hz=4350.0 * (poles - 1), refractory_us=20.0,
        photoreceptor=receptor, noise=NoiseParameters(RMS, 1900.0 * (poles - 1)),
    )  # fmt: skip
    return dataclasses.replace(p, **changes)


def of_pixels(case: Case, step_s: float) -> Stream:
    """Return the events of evstim's pixels."""
    return events(Method("refined", PixelArray, rate=True, refines=True), case, step_s)[0]


def of_reference(case: Case, step_s: float = 1e-3) -> Stream:
    """Return the events of the reference, whose grid is as fine as the steps."""
    delta_ns = min(grid_ns(case.parameters), round(step_s * 1e9))
    return events(Method("reference", partial(NoisyPixels, delta_ns=delta_ns), rate=True), case, step_s)[0]


SINES = [
    # light, amplitude, Hz
    (1.0, 0.1, 2.0), (1.0, 0.5, 0.5), (1.0, 0.5, 2.0), (1.0, 2.0, 10.0), (0.1, 0.25, 2.0), (0.1, 1.0, 10.0),
    (0.02, 0.5, 2.0), (0.02, 2.0, 0.5),
]  # fmt: skip


def sines(scale: float) -> Iterator[Line]:
    """Measure sines of all receptors and poles at all steps, with some 10 000 events each or more."""
    pixels = GROUPS * max(1, round(4 * scale))
    for receptor, poles in itertools.product(get_args(Receptor), (1, 2)):
        settings = SINES if receptor == "one_pole" else SINES[3:]  # the others do not distinguish them
        for light, amplitude, hz in settings:
            seconds = 2.0 * math.ceil(40 / (4 + 4 * amplitude * hz / THETA))
            p = sensor(light * math.exp(amplitude), poles, receptor, pixels)
            case = Case("sine", LogSine(pixels, amplitude, hz, light), p, seconds)
            true = of_reference(case)
            for step_ms in STEPS_MS:
                setting = f"{receptor}, {poles} poles, light {light:g}, A {amplitude:g}, {hz:g} Hz"
                yield Line(setting, step_ms, measured(behaviour(seconds), of_pixels(case, step_ms * 1e-3), true))


def still(scale: float) -> Iterator[Line]:
    """Measure still light in windows from the start on, in light of a tenth."""
    edges_s = 0.0, 0.1, 1.0, 4.0
    for poles in (1, 2):
        for ratio in (1.6, 2.0, 3.0, 4.0, 5.2, 7.2):
            pixels = GROUPS * max(1, round((12 if ratio < 5 else 50) * scale))
            passed = 1900 / (1900 + 3000 * (0.1 + DARK)) if poles == 2 else 1.0
            noise = NoiseParameters(THETA / ratio / math.sqrt(passed), 1900.0 * (poles - 1))
            for name, begin_s in (("reset", 0.0), ("signal", 0.04)):
                edge = LogEdge(pixels, 3.75 * THETA, 2e-3, 0.02, 0.1)
                scene = edge if name == "signal" else LogSine(pixels, 0.0, level=0.1)
                p = sensor(0.1, poles, "one_pole", pixels, noise=noise, random_start=name == "reset")
                case = Case("still", scene, p, begin_s + edges_s[-1])
                streams = of_pixels(case, 1e-2), of_reference(case)
                for a, b in itertools.pairwise(edges_s):
                    window = [one.where(np.floor_divide(one.t_us * 1e-6 - begin_s - a, b - a) == 0) for one in streams]
                    setting = f"{name}, {poles} poles, threshold {ratio:g} sigma, {a:g} to {b:g} s"
                    yield Line(setting, 10.0, measured(behaviour(b - a, 0.05 if ratio > 5 else 0.03), *window))


def ramps(scale: float) -> Iterator[Line]:
    """Measure ramps of ten thresholds through light 1 and 0.1, from the third on: noise may start beyond the first."""
    moments: list[Quantity] = [
        ("mean ms", lambda stream: float(stream.intervals_us().mean()) * 1e-3, 0.02),
        ("spread ms", lambda stream: float(stream.intervals_us().std()) * 1e-3, 0.05),
    ]
    for light, poles in ((1.0, 2), (1.0, 1), (0.1, 2), (0.1, 1)):
        for speed in (1.0, 10.0, 100.0, 1000.0):
            pixels, seconds = GROUPS * max(1, round((1 if speed == 1 else 12) * scale)), 10 / speed
            middle = math.exp(5 * THETA)
            scene = SlowRamp(pixels, speed * THETA, speed * THETA, light / middle)
            case = Case("ramp", scene, sensor(light * middle, poles, "one_pole", pixels), seconds)
            step_s, setting = min(seconds, 1e-2), f"{speed:g} thresholds/s, {poles} poles, light {light:g}"
            pair = [one.where(one.t_us > 3e6 / speed) for one in (of_pixels(case, step_s), of_reference(case))]
            yield Line(setting, 1e3 * step_s, measured(moments, *pair))


def edges(scale: float) -> Iterator[Line]:
    """Measure the first events at edges of 3.4 thresholds."""
    pixels = GROUPS * max(1, round(25 * scale))
    moments: list[Quantity] = [
        ("mean us", lambda stream: float(stream.t_us.mean()), 0.02),
        ("spread us", lambda stream: float(stream.t_us.std()), 0.05),
    ]
    for poles in (1, 2):
        for width_s in (2e-6, 2e-5, 2e-4, 2e-3):
            p = sensor(1.0, poles, "one_pole", pixels, random_start=False)
            case = Case("edge", LogEdge(pixels, 3.4 * THETA, width_s, 20 * width_s), p, 40 * width_s + 1e-3)
            true = first_events(of_reference(case, width_s / 4), 20e6 * width_s)
            for step_s in (width_s / 4, width_s):
                ours = first_events(of_pixels(case, step_s), 20e6 * width_s)
                yield Line(f"edge of {1e6 * width_s:g} us, {poles} poles", 1e3 * step_s, measured(moments, ours, true))


def first_events(stream: Stream, middle_us: float) -> Stream:
    """Return the first event of each pixel, by its time after a tenth of the edge."""
    first = np.zeros(len(stream), np.bool_)
    first[stream.first[:-1][stream.counts > 0]] = True
    chosen = stream.where(first)
    return Stream.of(chosen.t_us - 0.9 * middle_us, chosen.pixel, chosen.on, chosen.pixels)


def start(scale: float) -> Iterator[Line]:
    """Measure the start of presets in still light; the reference is evstim itself after 20 s."""
    pixels, history_s = GROUPS * max(1, round(256 * scale)), 20.0
    rate = behaviour(2.0)[:1]
    for preset, light in (("imx636", 0.0), ("imx636", 0.1), ("imx636", 1.0), ("imx636_quiet", 0.1)):
        p = dataclasses.replace(PRESETS[preset], width=pixels, height=1)
        scene = LogSine(pixels, 0.0, level=light) if light else Dark(pixels)
        before, without = (
            dataclasses.replace(p, noise=dataclasses.replace(p.noise, history_s=s)) for s in (history_s, 0.0)
        )
        ours = of_pixels(Case("start", scene, before, 2.0), 1e-2)
        later = of_pixels(Case("start", scene, without, history_s + 2.0), 1e-2)
        settled = later.where(later.t_us >= 1e6 * history_s)
        yield Line(f"{preset}, light {light:g}, from 0 to 2 s", 10.0, measured(rate, ours, settled))


class Restarted(PixelArray):
    """An array that is replaced by a new one with a copy of its state before each step."""

    def step(self, frame: LightFrame) -> Crossings:
        """See `PixelArray.step`."""
        self.heir = PixelArray(self.parameters, self.seed, 1)
        self.heir.state = copy.deepcopy(self.state)
        found = self.heir.step(frame)
        self.state = self.heir.state
        return found


def same(scale: float) -> Iterator[Line]:
    """Measure the share of the events that are those of one thread, in steps of 1 ms.

    Other steps give other events, whose rates, order and intervals `sines` measures.
    """
    pixels = max(16, round(1024 * scale))
    scenes: dict[str, ClosedLight] = {
        "still light": LogSine(pixels, 0.0, level=0.1),
        "ramp": SlowRamp(pixels, 0.2, 2.0, 0.1),
        "sine": LogSine(pixels, 0.5, 2.0, 0.1),
    }
    ways: dict[str, MakePixels] = {
        "two threads": partial(PixelArray, threads=2),
        "restarted": partial(Restarted, threads=1),
    }
    for poles, (name, scene) in itertools.product((1, 2), scenes.items()):
        case, first = Case("same", scene, sensor(3.0, poles, "one_pole", pixels), 1.6), partial(PixelArray, threads=1)
        true = events(Method("array", first, rate=True), case, 1e-3)[0]
        for words, make in ways.items():
            stream = events(Method("array", make, rate=True), case, 1e-3)[0]
            yield Line(f"{name}, {poles} poles, {words}", 1.0, [Measured("same", alike(stream, true), 1.0, 0.0, 0.0)])


def alike(stream: Stream, other: Stream) -> float:
    """Return the share of the events that the other stream has too, at the same time in the same pixel and polarity."""
    keys, theirs = (1e9 * (2 * one.pixel + one.on) + one.t_us for one in (stream, other))
    return float(np.isin(keys, theirs).mean())


CHECKS = {check.__name__: check for check in (sines, still, ramps, edges, start, same)}
app = App(name="noise")


@app.default
def main(
    *checks: Literal["sines", "still", "ramps", "edges", "start", "same"], scale: float = 1.0, json: bool = False
) -> None:
    """Run the checks, all unless some are named, with `scale` times as many pixels; print a line for each setting."""
    found: dict[str, list[Line]] = {}
    for check in checks or CHECKS:
        found[check] = []
        for line in CHECKS[check](scale):
            print(line, flush=True)
            found[check].append(line)
        every = [one for line in found[check] for one in line.measured if math.isfinite(one.ratio)]
        quantiles = np.quantile([abs(one.ratio - 1) for one in every], (0.5, 0.95))
        print(f"{check}: {sum(one.is_off for one in every)} of {len(every)} ratios are off; half of them are within"
              f" {quantiles[0]:.2%} of 1, 95 % within {quantiles[1]:.2%}")  # fmt: skip
    if json:
        print(to_json.dumps({check: [[*line[:2], [one._asdict() for one in line.measured]] for line in lines]
                             for check, lines in found.items()}))  # fmt: skip


if __name__ == "__main__":
    app()
