"""Time of a whole sensor with its preset's noise over that without, in one thread, step by step in turns.

    python -m laboratory.benchmarks.noise_cost [BLOCKS]

Both sensors see the same light frames, 1 ms apart, and read their events out:

    still      light that does not change at all: blocks of pixels that rest are skipped
    flicker    all light changes by 1e-4 in each step, and nothing fires but noise: no pixel is skipped
    moving     a grating of contrast 0.5 drifts by 200 pixels a second through a fifth of the rows

A line has the medians over blocks of 64 steps of processor time (of the thread) and of wall time, the ratio of the
medians with the quartiles of the blocks' own ratios, and the events a second of both. On a machine with other work only
the ratios of processor times mean something.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import sys
import time
from collections.abc import Iterator
from functools import partial

import numpy as np
import numpy.typing as npt

from emulator.light import LightFrame
from emulator.sensor.presets import PRESETS, SensorParameters
from emulator.sensor.sensor import Sensor, own_pixels

CASES = {"davis346, 346 x 260": ("davis346", 0.5), "imx636, 1280 x 720": ("imx636", 0.5)}
STEPS, STEP_NS = 64, 1_000_000
WAVELENGTH_PX, SPEED_PX_S = 12.8, 200.0  # a period is 64 steps
MOVING_SHARE = 0.2
SETTLE_BLOCKS = 4

Lights = list[npt.NDArray[np.float32]]


def lights(p: SensorParameters, level: float) -> dict[str, Lights]:
    """Return the light of each scene, repeated after as many steps."""
    still = np.full((p.height, p.width), level, np.float32)
    moving, rows = [], slice(0, round(MOVING_SHARE * p.height))
    for k in range(STEPS):
        frame = still.copy()
        phase = 2 * math.pi * (np.arange(p.width) - SPEED_PX_S * k * STEP_NS * 1e-9) / WAVELENGTH_PX
        frame[rows] = level * (1 + 0.5 * np.sin(phase))
        moving.append(frame)
    return {"still": [still], "flicker": [still, still * np.float32(1 + 1e-4)], "moving": moving}


def blocks(sensors: tuple[Sensor, Sensor], frames: Lights) -> Iterator[npt.NDArray[np.float64]]:
    """Return for each block the processor seconds, wall seconds and events of each sensor, (2, 3); without an end."""
    for sensor in sensors:
        sensor.reset(LightFrame(0, frames[0]))
    for block in itertools.count():
        spent = np.zeros((2, 3))
        for k in range(block * STEPS + 1, (block + 1) * STEPS + 1):
            for which in (0, 1) if k % 2 else (1, 0):  # neither always finds the other's caches
                cpu_s, wall_s = time.thread_time(), time.perf_counter()
                events = sensors[which].expose(LightFrame(k * STEP_NS, frames[k % len(frames)]))
                spent[which] += time.thread_time() - cpu_s, time.perf_counter() - wall_s, len(events)
        yield spent


def main(count: str = "24") -> None:
    """Print a line for each sensor and scene."""
    make = partial(own_pixels, threads=1)
    for name, (preset, level) in CASES.items():
        p = PRESETS[preset]
        quiet = dataclasses.replace(p, noise=dataclasses.replace(p.noise, rms=0.0))
        for scene, frames in lights(p, level).items():
            taken = blocks((Sensor(p, 1, make), Sensor(quiet, 1, make)), frames)
            spent = np.array(list(itertools.islice(taken, SETTLE_BLOCKS, SETTLE_BLOCKS + int(count))))
            _print(f"{name:20} {scene:8}", spent)


def _print(what: str, spent: npt.NDArray[np.float64]) -> None:
    """Print one line from (blocks, 2, 3)."""
    cpu, wall = (np.median(spent[:, :, k], axis=0) / STEPS * 1e6 for k in (0, 1))
    low, high = np.quantile(spent[:, 0, 0] / spent[:, 1, 0], (0.25, 0.75))
    rates = spent[:, :, 2].mean(0) / (STEPS * STEP_NS * 1e-9)
    print(
        f"{what} processor {cpu[0]:7.1f} and {cpu[1]:7.1f} us a step, ratio {cpu[0] / cpu[1]:.2f}"
        f" ({low:.2f} to {high:.2f}); wall ratio {wall[0] / wall[1]:.2f}; {rates[0]:.3g} and {rates[1]:.3g} events/s",
        flush=True,
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
