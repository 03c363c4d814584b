"""Cost of noise: beside OpenEB's simulator, before the start, and in the shipped rigs. Processor time.

    python -m laboratory.bench.noise_cost openeb PATH [--steps 100] [--json]
    python -m laboratory.bench.noise_cost start [--json]
    python -m laboratory.bench.noise_cost rigs [--json]

PATH is a checkout of OpenEB, `git clone https://github.com/prophesee-ai/openeb`: nothing of it is compiled, as its
simulator is Python and numba. Both simulators get the same light in one process and on one thread, 346 x 260 pixels in
steps of 1 ms; OpenEB with all that it models. A line has the medians of the steps, and their ratio.
"""

from __future__ import annotations

import dataclasses
import itertools
import json as to_json
import time
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
from cyclopts import App

from emulator.light import LightFrame
from emulator.rig.loading import load_rig
from emulator.run.assembly import build_scene
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import PRESETS, SensorParameters
from emulator.sensor.sensor import Sensor
from laboratory.accuracy.peers import adapters
from laboratory.accuracy.peers.worker import Frame, Settings
from laboratory.bench.streams import processor_time_s

SIZE = 346, 260
STEP_S = 1e-3
FIRST_STEPS = 20  # compile, and settle
START_SIZE = 1280, 720
START_LIGHTS = 0.0, 0.1, 1.0
RIGS = "eros", "itokawa", "eros-flyover", "rendezvous", "malapert"
RIG_STEPS = 8

Scene = Literal["grating", "edge"]
app = App(name="noise_cost")


class Beside(NamedTuple):
    """Median processor time of a step of both simulators, s, and their events a step in the mean."""

    scene: Scene
    preset: str
    noise: bool
    ours_s: float
    openeb_s: float
    our_events: float
    openeb_events: float

    def __str__(self) -> str:
        pixels = SIZE[0] * SIZE[1] * 1e-6
        return (
            f"{self.scene:8} {self.preset:9} {'with' if self.noise else 'without'} noise: {pixels / self.ours_s:.1f}"
            f" Mpixel/s ({self.our_events:.0f} events a step), OpenEB {pixels / self.openeb_s:.1f}"
            f" ({self.openeb_events:.0f}): {self.openeb_s / self.ours_s:.2f} times"
        )


class Start(NamedTuple):
    """Processor time of a sensor's reset with noise and without, s."""

    preset: str
    light: float
    noise_s: float
    without_s: float

    def __str__(self) -> str:
        return f"{self.preset:12} light {self.light:g}: {self.noise_s:.2f} s, without noise {self.without_s:.2f} s"


class RigStep(NamedTuple):
    """Median processor time of a step's pixels with noise, with that of offsets, and without, s, and mean events."""

    rig: str
    noise_s: float
    offsets_s: float
    without_s: float
    events: float
    events_offsets: float
    events_without: float

    def __str__(self) -> str:
        spent_s, events = (self.noise_s, self.offsets_s, self.without_s), self[4:]
        of = zip(("noise", "offsets", "no noise"), spent_s, events, strict=True)
        return f"{self.rig:12} " + ", ".join(f"{name} {s * 1e3:.1f} ms, {n:.0f} events" for name, s, n in of)


def parameters(preset: str, size: tuple[int, int], *, noise: bool) -> SensorParameters:
    """Return a preset with another size, with its noise or without."""
    p = dataclasses.replace(PRESETS[preset], width=size[0], height=size[1])
    return p if noise else dataclasses.replace(p, noise=dataclasses.replace(p.noise, rms=0.0))


def frames(scene: Scene, steps: int) -> Iterator[Frame]:
    """Yield a grating that moves over all pixels, 20 periods a second, or an edge that crosses 9 % of the columns."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    for k in range(steps):
        t_s = k * STEP_S
        if scene == "grating":
            phase, contrast = 2 * np.pi * (20 * t_s + x / 37 + y / 53), 0.7
            light = (1 + contrast * np.sin(phase)) / (1 + contrast)
            rate = contrast * 2 * np.pi * 20 * np.cos(phase) / (1 + contrast)
        else:
            columns, blur = 0.09 * SIZE[0], 0.5
            passed = 1 / (1 + np.exp(np.clip((x - 100 - columns * k / steps) / blur, -60, 60)))
            light, rate = 0.1 + 0.9 * passed, 0.9 * passed * (1 - passed) / blur * columns / (steps * STEP_S)
        yield Frame(round(t_s * 1e9), light.astype(np.float32), rate.astype(np.float32))


def beside(scene: Scene, preset: str, path: str, steps: int, *, noise: bool = True) -> Beside:
    """Return the times of both simulators in `steps` steps after the first."""
    p = parameters(preset, SIZE, noise=noise)
    sensor, steps = Sensor(p, 1, partial(PixelArray, threads=1)), steps + FIRST_STEPS
    other = adapters.openeb(Settings(*SIZE, p.threshold_on, p.threshold_off, scene, 1 / STEP_S, steps, True, path))
    taken: list[tuple[float, float, int, int]] = []
    for k, frame in enumerate(frames(scene, steps)):
        light = LightFrame(*frame)
        if k == 0:
            sensor.reset(light)
        begin_s = time.process_time()
        our_events = len(sensor.expose(light)) if k else 0
        middle_s = time.process_time()
        openeb_events = len(other.step(frame)[0])
        taken.append((middle_s - begin_s, time.process_time() - middle_s, our_events, openeb_events))
    ours_s, openeb_s, our_events, openeb_events = np.array(taken[FIRST_STEPS:]).T
    return Beside(
        scene, preset, noise, float(np.median(ours_s)), float(np.median(openeb_s)), our_events.mean(),
        openeb_events.mean(),
    )  # fmt: skip


def started(preset: str, light: float, size: tuple[int, int] = START_SIZE) -> Start:
    """Return the less of two processor times of a sensor's reset in still light, after one that compiles."""
    frame, found_s = LightFrame(0, np.full(size[::-1], light, np.float32)), []
    for noise in (True, False):
        reset = partial(Sensor(parameters(preset, size, noise=noise), 1).reset, frame)
        found_s.append(min([processor_time_s(reset) for _ in range(3)][1:]))
    return Start(preset, light, *found_s)


def stepped(name: str, size: tuple[int, int] = START_SIZE) -> RigStep:
    """Return the times of the pixels of `imx636` in the light of a shipped rig, from 0 s, on one thread."""
    rig = load_rig(name)
    taken: list[tuple[float, int]] = []
    full, without = (parameters("imx636", size, noise=noise) for noise in (True, False))
    offsets = dataclasses.replace(full, noise=dataclasses.replace(full.noise, grade="offsets"))
    arrays = [PixelArray(p, 1, threads=1) for p in (full, offsets, without)]
    with build_scene(rig, size) as scene:
        for t_ns in range(0, (RIG_STEPS + 1) * rig.run.step_us * 1000, rig.run.step_us * 1000):
            light, rate = np.zeros((2, *size[::-1]), np.float32)
            scene.light_and_rate(t_ns, light, rate)
            frame = LightFrame(t_ns, light, rate)
            for array in arrays:
                if t_ns == 0:
                    array.reset(frame)
                    continue
                begin_s = time.process_time()
                count = len(array.step(frame).t_ns)
                taken.append((time.process_time() - begin_s, count))
    spent_s, events = np.array(taken).reshape(RIG_STEPS, len(arrays), 2).T
    return RigStep(name, *np.median(spent_s, axis=1), *events.mean(axis=1))


def _report(found: Iterable[Beside | Start | RigStep], json: bool) -> None:
    lines = []
    for line in found:
        print(line, flush=True)
        lines.append(line._asdict())
    if json:
        print(to_json.dumps(lines))


@app.command
def openeb(path: Path, *, steps: int = 100, json: bool = False) -> None:
    """Measure the whole sensor beside OpenEB's simulator: `davis346` and `imx636` with noise, `imx636` without."""
    if not (path / "sdk/modules/core_ml/python/pypkg/metavision_core_ml").is_dir():
        raise SystemExit(f"{path}: is no checkout of OpenEB:  git clone https://github.com/prophesee-ai/openeb {path}")
    settings = itertools.product((("davis346", True), ("imx636", True), ("imx636", False)), get_args(Scene))
    place = str(path.absolute())
    _report((beside(scene, preset, place, steps, noise=noise) for (preset, noise), scene in settings), json)


@app.command
def start(*, json: bool = False) -> None:
    """Measure the reset at 1280 x 720, where the noise before the start is drawn, in still light."""
    _report(itertools.starmap(started, itertools.product(("imx636", "imx636_quiet", "davis346"), START_LIGHTS)), json)


@app.command
def rigs(*, json: bool = False) -> None:
    """Measure a step's pixels at 1280 x 720 with `imx636` in the light of shipped rigs, with noise and without."""
    _report(map(stepped, RIGS), json)


if __name__ == "__main__":
    app()
