"""Draw docs/pictures/activity.png, the time of a pixel step over the share of active pixels.

The light frame is black except for a band of rows in which a grating drifts. One thread; with and without a report of
the changed region. Each time is processor time, the least of 6 steps, to reduce the influence of other work on the
machine. Run it on an idle machine: `python docs/activity_chart.py`.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from emulator.light import Light, LightFrame, Region
from emulator.report.page import pyplot, save
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import PRESETS
from laboratory.bench.pixels import grating

SIZES = (346, 260), (640, 480), (1280, 720), (2048, 2048), (4096, 4096)
SHARES = 0.0, 0.001, 0.01, 0.1, 1.0
STEP_NS = 1_000_000
REPEATS_ROWS = 80  # of the grating
WARM_UP, STEPS = 6, 6


def repeat(tile: tuple[Light, Light], light: Light, rate: Light) -> None:
    """Fill light and rate with the grating's first rows, over and over."""
    for top in range(0, light.shape[0], REPEATS_ROWS):
        for part, whole in zip(tile, (light, rate), strict=True):
            rows = whole[top : top + REPEATS_ROWS]
            rows[:] = part[: rows.shape[0]]


def step_us(array: PixelArray, share: float, *, reported: bool) -> float:
    """Return the least processor time of a step, us, with a drifting grating in `share` of the rows."""
    width, height = array.parameters.width, array.parameters.height
    rows = round(share * height)
    band = dataclasses.replace(array.parameters, height=REPEATS_ROWS)
    light, rate = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    array.reset(LightFrame(0, light, rate))
    changed, taken = Region(0, rows, 0, width) if reported else None, []
    for k in range(1, WARM_UP + STEPS + 1):
        if rows:
            repeat(grating(band, -0.01 * k, 0.01), light[:rows], rate[:rows])
        begun = time.thread_time()
        array.step(LightFrame(k * STEP_NS, light, rate, changed=None if k < 4 else changed))
        taken.append(time.thread_time() - begun)
    return min(taken[WARM_UP:]) * 1e6


Row = tuple[tuple[int, int], bool, list[float]]
"""Size, whether the changed region is reported, and microseconds a step by share."""


def measured() -> Iterator[Row]:
    """Yield the rows of all sizes, and print them."""
    for size in SIZES:
        parameters = dataclasses.replace(PRESETS["davis346"], width=size[0], height=size[1], leak_hz=0.0,
                                         noise=NoiseParameters())  # fmt: skip
        array = PixelArray(parameters, 1, 1)
        for reported in (False, True):
            times = [step_us(array, share, reported=reported) for share in SHARES]
            words = "reported" if reported else "compared", *(f"{t:.0f}" for t in times)
            sys.stdout.write(f"{size[0]}x{size[1]} {' '.join(words)}\n")
            sys.stdout.flush()
            yield size, reported, times


def draw(rows: list[Row]) -> None:
    """Draw one line a row."""
    figure, axes = pyplot().subplots(figsize=(7, 4.6), layout="constrained")
    shares = [max(share, 3e-4) for share in SHARES]
    for size, reported, times in rows:
        label = f"{size[0]} x {size[1]}" if reported else None
        colour = f"C{SIZES.index(size)}"
        axes.plot(shares, times, "-" if reported else "--", color=colour, marker=".", label=label)
    axes.set(xscale="log", yscale="log", xlabel="share of active pixels (leftmost: none)")
    axes.set_ylabel("processor time of a step, us")
    axes.set_title("solid: the scene reports the changed region; dashed: pictures are compared", fontsize=9)
    axes.grid(True, which="major", alpha=0.3)
    axes.legend(fontsize=8)
    save(figure, Path(__file__).parent / "pictures" / "activity")


if __name__ == "__main__":
    draw(list(measured()))
