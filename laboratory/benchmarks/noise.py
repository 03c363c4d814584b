"""Noise of evstim's pixels beside the reference of `laboratory.methods.grid`, which shares no code with it.

    python -m laboratory.benchmarks.noise [CHECK ...] [--scale 1] [--json]

    sines     rates, order and intervals on sines in log light, contrast 0.1 to 2, 0.5 to 10 Hz, light 1 to 0.02
    still     the same in still light, after a reset and after events of a signal, threshold over sigma 1.6 to 7.2
    ramps     mean and spread of the intervals on ramps of 1 to 1000 thresholds a second
    edges     mean and spread of the first event's time at edges of 2 us to 2 ms
    same      share of the events that are the same in other steps, with two threads, and after a restart

All checks take half an hour on one core, and `--scale 0.1` a tenth of the pixels. Both sides have the same thresholds,
the same start and the same light: the pixels get frames with the time derivative, and light of single pixels between
them, and the reference gets frames every millisecond or less. A line has for each quantity that of the pixels, that of
the reference, and their ratio with its standard error, from eight groups of pixels; a star marks a ratio that is off
the target by more than two standard errors.
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
import json as to_json
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
from cyclopts import App

from emulator.light import LightFrame
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import SensorParameters
from laboratory.accuracy.harness import SEED, Case, Method, events
from laboratory.accuracy.scenes import ClosedLight, LogEdge, LogSine, SlowRamp
from laboratory.accuracy.scores import Stream
from laboratory.methods.grid import NoisyPixels, grid_ns

THETA, RMS, DARK = 0.223, 0.045, 0.009
STEPS_MS = 0.2, 1.0, 10.0, 80.0
GROUPS = 8

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

    check: str
    setting: str
    step_ms: float
    measured: list[Measured]

    def __str__(self) -> str:
        return f"{self.check:6} {self.setting:44} {self.step_ms:6g} ms  {'  '.join(map(str, self.measured))}"


def measured(name: str, of: Callable[[Stream], float], ours: Stream, true: Stream, target: float) -> Measured:
    """Return a quantity of two streams of the same pixels."""
    parts = [[of(one.where(one.pixel % GROUPS == k)) for one in (ours, true)] for k in range(GROUPS)]
    differences = [a - b for a, b in parts]
    whole = of(true)
    error = np.std(differences) / math.sqrt(GROUPS - 1) / (np.mean([b for _, b in parts]) or math.nan)
    return Measured(name, of(ours), whole, float(error), target)


def opposite(stream: Stream) -> float:
    """Return the share of the events whose next one has the other polarity."""
    return float(stream.words(2)[1:3].sum())


def quantile(level: float, stream: Stream) -> float:
    """Return a quantile of the intervals, ms."""
    intervals = stream.intervals_us()
    return float(np.quantile(intervals, level)) * 1e-3 if intervals.size else math.nan


def behaviour(ours: Stream, true: Stream, seconds: float, target: float = 0.03) -> list[Measured]:
    """Return rate (Hz), order and intervals (ms)."""
    out = [measured("Hz", lambda stream: len(stream) / stream.pixels / seconds, ours, true, target)]
    out += [measured("opposite", opposite, ours, true, target)]
    return out + [measured(f"{q:.0%}", partial(quantile, q), ours, true, target) for q in (0.05, 0.5, 0.95)]


def sensor(light: float, poles: int, receptor: Receptor, pixels: int, **changes: Any) -> SensorParameters:
    """Return a sensor like an imx636, its highest corner frequency that of `light`: the reference's steps follow it."""
    hz, fixed_hz = 3000.0 * (light + DARK), 1900.0 * (poles - 1)
    return dataclasses.replace(
        SensorParameters(
            width=pixels, height=1, threshold_on=THETA, threshold_off=THETA, dark_current_relative=DARK, leak_hz=0.0,
            corner_max_hz=hz, source_follower_hz=4350.0 * (poles - 1), refractory_us=20.0, photoreceptor=receptor,
            noise=NoiseParameters(RMS, fixed_hz),
        ),
        **changes,
    )  # fmt: skip


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
    pixels = GROUPS * max(2, round(16 * scale))
    kinds: list[tuple[Receptor, int]] = [("one_pole", 1), ("one_pole", 2), ("large_signal", 1), ("large_signal", 2)]
    for receptor, poles in kinds:
        for light, amplitude, hz in SINES:
            seconds = 2.0 * math.ceil(40 / (4 + 4 * amplitude * hz / THETA))
            p = sensor(light * math.exp(amplitude), poles, receptor, pixels)
            case = Case("sine", LogSine(pixels, amplitude, hz, light), p, seconds)
            true = of_reference(case)
            for step_ms in STEPS_MS:
                setting = f"{receptor}, {poles} poles, light {light:g}, A {amplitude:g}, {hz:g} Hz"
                yield Line("sines", setting, step_ms, behaviour(of_pixels(case, step_ms * 1e-3), true, seconds))


def still(scale: float) -> Iterator[Line]:
    """Measure still light in windows from the start on, in light of a tenth."""
    edges_s = 0.0, 0.1, 1.0, 4.0
    for poles in (1, 2):
        for ratio in (1.6, 2.0, 3.0, 4.0, 5.2, 7.2):
            pixels = GROUPS * max(8, round((50 if ratio < 5 else 200) * scale))
            passed = 1900 / (1900 + 3000 * (0.1 + DARK)) if poles == 2 else 1.0
            noise = NoiseParameters(THETA / ratio / math.sqrt(passed), 1900.0 * (poles - 1))
            p = sensor(0.1, poles, "one_pole", pixels, noise=noise, refractory_us=20.0)
            signal = dataclasses.replace(p, random_start=False)
            starts: list[tuple[str, ClosedLight, SensorParameters, float]] = [
                ("reset", LogSine(pixels, 0.0, level=0.1), p, 0.0),
                ("signal", LogEdge(pixels, 3.75 * THETA, 2e-3, 0.02, 0.1), signal, 0.04),
            ]
            for name, scene, parameters, begin_s in starts:
                case = Case("still", scene, parameters, begin_s + edges_s[-1])
                streams = of_pixels(case, 1e-2), of_reference(case)
                for a, b in itertools.pairwise(edges_s):
                    t0_us, t1_us = 1e6 * (begin_s + a), 1e6 * (begin_s + b)
                    window = [stream.where((stream.t_us >= t0_us) & (stream.t_us < t1_us)) for stream in streams]
                    setting = f"{name}, {poles} poles, threshold {ratio:g} sigma, {a:g} to {b:g} s"
                    yield Line("still", setting, 10.0, behaviour(*window, b - a, 0.05 if ratio > 5 else 0.03))


def ramps(scale: float) -> Iterator[Line]:
    """Measure ramps of ten thresholds through light 1 and 0.1."""
    moments = ("mean ms", lambda s: float(s.intervals_us().mean()) * 1e-3, 0.02), (
        "spread ms", lambda s: float(s.intervals_us().std()) * 1e-3, 0.05)  # fmt: skip
    for light, poles in ((1.0, 2), (1.0, 1), (0.1, 2), (0.1, 1)):
        for speed in (1.0, 10.0, 100.0, 1000.0):
            pixels, seconds = GROUPS * max(4, round((5 if speed == 1 else 50) * scale)), 10 / speed
            middle = math.exp(5 * THETA)
            scene = SlowRamp(pixels, speed * THETA, speed * THETA, light / middle)
            case = Case("ramp", scene, sensor(light * middle, poles, "one_pole", pixels), seconds)
            ours, true = of_pixels(case, min(seconds, 1e-2)), of_reference(case)
            line = [measured(name, of, ours, true, target) for name, of, target in moments]
            yield Line(
                "ramps", f"{speed:g} thresholds/s, {poles} poles, light {light:g}", 1e3 * min(seconds, 1e-2), line
            )


def edges(scale: float) -> Iterator[Line]:
    """Measure the first events at edges of 3.4 thresholds."""
    pixels = GROUPS * max(8, round(100 * scale))
    moments = ("mean us", lambda s: float(s.t_us.mean()), 0.02), ("spread us", lambda s: float(s.t_us.std()), 0.05)
    for poles in (1, 2):
        for width_s in (2e-6, 2e-5, 2e-4, 2e-3):
            p = sensor(1.0, poles, "one_pole", pixels, random_start=False)
            case = Case("edge", LogEdge(pixels, 3.4 * THETA, width_s, 20 * width_s), p, 40 * width_s + 1e-3)
            true = first_events(of_reference(case, width_s / 4), 20e6 * width_s)
            for step_s in (width_s / 4, width_s):
                ours = first_events(of_pixels(case, step_s), 20e6 * width_s)
                line = [measured(name, of, ours, true, target) for name, of, target in moments]
                yield Line("edges", f"{1e6 * width_s:g} us, {poles} poles", 1e3 * step_s, line)


def first_events(stream: Stream, middle_us: float) -> Stream:
    """Return the first event of each pixel, by its time after a tenth of the edge."""
    first = np.zeros(len(stream), np.bool_)
    first[stream.first[:-1][stream.counts > 0]] = True
    chosen = stream.where(first)
    return Stream.of(chosen.t_us - 0.9 * middle_us, chosen.pixel, chosen.on, chosen.pixels)


def same(scale: float) -> Iterator[Line]:
    """Measure the share of events within 0, 1 and 100 us of those in steps of 1 ms on one thread.

    In other steps moving light, and float32, is not the same to the last bit.
    """
    pixels, seconds = max(16, round(1024 * scale)), 1.6
    scenes: dict[str, ClosedLight] = {
        "still light": LogSine(pixels, 0.0, level=0.1),
        "ramp": SlowRamp(pixels, 0.2, 2.0, 0.1),
        "sine": LogSine(pixels, 0.5, 2.0, 0.1),
    }
    for poles in (1, 2):
        for name, scene in scenes.items():
            case = Case("same", scene, sensor(3.0, poles, "one_pole", pixels), seconds)
            unbroken = restarted(case, 1, 1e-3, False)
            for words, other, step_ms in (
                *(("step", restarted(case, 1, ms * 1e-3, False), ms) for ms in STEPS_MS),
                ("two threads", restarted(case, 2, 1e-3, False), 1.0),
                ("restarted", restarted(case, 1, 1e-3, True), 1.0),
            ):
                exact = name == "still light" or words != "step"
                targets = ((0.0, 0.0 if exact else 1.0), (1.0, 0.03), (100.0, 0.01))
                line = [Measured(f"{us:g} us", alike(other, unbroken, us), 1.0, 0.0, target) for us, target in targets]
                yield Line("same", f"{name}, {poles} poles, {words}", step_ms, line)


def restarted(case: Case, threads: int, step_s: float, restart: bool) -> Stream:
    """Return the events of pixels; with `restart` another array continues from a copy of the state in each step."""

    def make(p: SensorParameters, seed: int) -> PixelArray:
        return Restarting(p, seed, threads) if restart else PixelArray(p, seed, threads)

    return events(Method("array", make, rate=True, refines=True), case, step_s)[0]


class Restarting(PixelArray):
    """An array that is replaced by a new one with a copy of its state before each step."""

    def step(self, frame: LightFrame) -> Any:
        """See `PixelArray.step`."""
        self._next = PixelArray(self.parameters, SEED, 1)
        self._next.state = copy.deepcopy(self.state)
        found = self._next.step(frame)
        self.state = self._next.state
        return found


def alike(stream: Stream, other: Stream, within_us: float) -> float:
    """Return the share of the events that the other stream has within a time, in the same pixel and polarity."""
    keys, theirs = (np.sort(1e9 * (2 * one.pixel + one.on) + one.t_us) for one in (stream, other))
    after = np.append(theirs, np.inf)[np.searchsorted(theirs, keys)]
    before = np.insert(theirs, 0, -np.inf)[np.searchsorted(theirs, keys, side="right")]
    return float((np.minimum(after - keys, keys - before) <= within_us).mean())


CHECKS: dict[str, Callable[[float], Iterator[Line]]] = {
    "sines": sines, "still": still, "ramps": ramps, "edges": edges, "same": same,
}  # fmt: skip
app = App(name="noise")


@app.default
def main(*checks: Literal["sines", "still", "ramps", "edges", "same"], scale: float = 1.0, json: bool = False) -> None:
    """Run the checks, all unless some are named, with `scale` times as many pixels; print a line for each setting."""
    lines = []
    for check in checks or CHECKS:
        for line in CHECKS[check](scale):
            print(line, flush=True)
            lines.append({**line._asdict(), "measured": [one._asdict() for one in line.measured]})
    if json:
        print(to_json.dumps({"lines": lines}))


if __name__ == "__main__":
    app()
