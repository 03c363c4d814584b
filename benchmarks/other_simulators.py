"""Cost of a step beside v2e's and OpenEB's own kernels, all with their non-idealities on.

    python benchmarks/other_simulators.py --v2e CHECKOUT --openeb CHECKOUT [--threads 1] [--share 0.04] [--steps 200]

Each program gets the same frames (346 x 260, 1 ms apart, a drifting grating in log light at which about `share` of the
pixels fire in a step) and does in its own way what it does from frame to list of events:

    evstim    the davis346 sensor whole: second pole, leaks, mismatch, refractory period, noise, arbiter
    v2e       EventEmulator.generate_events: low-pass, leak, shot noise, mismatch, refractory period, on the CPU
    openeb    GPUEventSimulator: dynamic_moving_average (its low-pass) and get_events, leak, shot noise, mismatch,
              refractory period, its kernels for the CPU

The programs run in turns, a block of steps each, and the figure is the least CPU time of a block, threads together, so
that a busy machine does as little harm as possible. CHECKOUT is a clone of the program's repository; its dependencies
(torch, opencv) must be there for this interpreter. A part of v2e that draws and asks is replaced by nothing. No test
and no CI job runs this.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from emulator.evaluation.bench.pixels import grating
from emulator.light import LightFrame
from emulator.sensor.presets import PRESETS
from emulator.sensor.sensor import Sensor

__all__ = ["main"]

_BLOCK = 25
_WARM_UP = 30
_SWING = 2.0  # of the grating, ln
_UNUSED = ("easygui", "screeninfo", "engineering_notation", "dv_processing", "tkinter", "cv2", "h5py")
_OPENEB = "sdk/modules/core_ml/python/pypkg/metavision_core_ml/video_to_event"

Step = Callable[[int], int]
"""Gives the frame of that number to a program, and returns the number of events."""


def frames(share: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return one period of frames, relative light, and their time derivatives."""
    p = PRESETS["davis346"]
    threshold = (p.threshold_on + p.threshold_off) / 2
    count = max(2, round(2 * (_SWING - threshold) / (share * threshold)))
    pictures = [grating(p, -2 * np.pi * k / count, 2 * np.pi / count) for k in range(count)]
    return [light for light, _ in pictures], [rate for _, rate in pictures]


def evstim(lights: list[np.ndarray], rates: list[np.ndarray]) -> Step:
    """Return the step of the whole sensor, its light with its derivative."""
    sensor = Sensor(PRESETS["davis346"], 1)
    sensor.reset(LightFrame(0, lights[0]))
    return lambda k: len(sensor.expose(LightFrame(k * 1_000_000, lights[k % len(lights)], rates[k % len(rates)])))


class _Nothing(types.ModuleType):
    """A module that has every name and does nothing."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {"__init__": lambda self, *a, **k: None, "__call__": lambda self, *a, **k: None})


def _stand_in() -> None:
    """Put an empty module where one that a program imports, and does not need here, is missing."""
    for name in _UNUSED:
        try:
            importlib.import_module(name)
        except ImportError:
            sys.modules[name] = _Nothing(name)


def v2e(checkout: Path, lights: list[np.ndarray]) -> Step:
    """Return the step of v2e's emulator."""
    _stand_in()
    sys.path.insert(0, str(checkout))
    emulator = importlib.import_module("v2ecore.emulator").EventEmulator(
        pos_thres=0.283, neg_thres=0.262, sigma_thres=0.01, cutoff_hz=286, leak_rate_hz=0.1, shot_noise_rate_hz=1.0,
        refractory_period_s=0.0005, seed=1, device="cpu", output_width=346, output_height=260,
    )  # fmt: skip
    scaled = [255 * light / max(float(one.max()) for one in lights) for light in lights]

    def step(k: int) -> int:
        events = emulator.generate_events(scaled[k % len(scaled)], k * 1e-3)
        return 0 if events is None else len(events)

    return step


def openeb(checkout: Path, lights: list[np.ndarray]) -> Step:
    """Return the step of OpenEB's simulator; its package is loaded without the rest of Metavision."""
    package = types.ModuleType("video_to_event")
    package.__path__ = [str(checkout / _OPENEB)]
    sys.modules["video_to_event"] = package
    torch = importlib.import_module("torch")
    simulator = importlib.import_module("video_to_event.gpu_simulator").GPUEventSimulator(
        1, 260, 346, c_mu=[0.262, 0.283], c_std=0.01, refractory_period=500, leak_rate_hz=0.1, cutoff_hz=286,
        shot_noise_hz=1.0,
    )  # fmt: skip
    brightest = max(float(one.max()) for one in lights)
    stacked = [torch.from_numpy((255 * light / brightest).astype(np.uint8)[..., None]) for light in lights]
    one = torch.tensor([1], dtype=torch.int32)

    def step(k: int) -> int:
        times = torch.tensor([[k * 1000.0]])
        first = torch.tensor([1.0 if k == 0 else 0.0])
        logs = simulator.dynamic_moving_average(stacked[k % len(stacked)], one, times, first)
        return len(simulator.get_events(logs, one, times, first))

    return step


def measure(steps: dict[str, Step], number: int) -> dict[str, tuple[float, float]]:
    """Return, for each program, the least CPU milliseconds of a step over blocks, and its events in a step."""
    for step in steps.values():
        for k in range(_WARM_UP):
            step(k)
    found = {name: (np.inf, 0.0) for name in steps}
    for begin in range(_WARM_UP, _WARM_UP + number, _BLOCK):
        for name, step in steps.items():
            start = time.process_time()
            events = sum(step(k) for k in range(begin, begin + _BLOCK))
            cost = (time.process_time() - start) / _BLOCK * 1e3
            found[name] = min(found[name], (cost, events / _BLOCK))
    return found


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--v2e", type=Path, help="a clone of v2e's repository")
    parser.add_argument("--openeb", type=Path, help="a clone of OpenEB's repository")
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    parser.add_argument("--share", type=float, default=0.04, help="share of the pixels that fire in a step")
    parser.add_argument("--steps", type=int, default=200)
    given = parser.parse_args()
    lights, rates = frames(given.share)
    steps: dict[str, Step] = {"evstim": evstim(lights, rates)}
    if given.v2e:
        steps["v2e"] = v2e(given.v2e, lights)
    if given.openeb:
        steps["openeb"] = openeb(given.openeb, lights)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(given.threads)
    found = measure(steps, given.steps)
    for name, (cost_ms, events) in found.items():
        ratio = cost_ms / found["evstim"][0]
        print(f"{name:8} {cost_ms:9.3f} ms of CPU a step {events:9.0f} events a step {ratio:8.1f} x")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
