"""Noise of a sensor: its cost in time, and its events beside a reference.

python -m laboratory.benchmarks.noise cost [BLOCKS]
python -m laboratory.benchmarks.noise points [PIXELS]
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import numba
import numpy as np
import numpy.typing as npt
from cyclopts import App

from emulator.light import LightFrame
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.state import draw
from emulator.sensor.presets import PRESETS, SensorParameters
from emulator.sensor.sensor import Sensor, own_pixels

app = App(name="noise")

COSTS = {"davis346, 346 x 260": ("davis346", 0.5), "imx636, 1280 x 720": ("imx636", 0.5)}
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
    for either in sensors:
        either.reset(LightFrame(0, frames[0]))
    for block in itertools.count():
        spent = np.zeros((2, 3))
        for k in range(block * STEPS + 1, (block + 1) * STEPS + 1):
            for sensor in (0, 1) if k % 2 else (1, 0):  # neither always finds the other's caches
                cpu_s, wall_s = time.thread_time(), time.perf_counter()
                events = sensors[sensor].expose(LightFrame(k * STEP_NS, frames[k % len(frames)]))
                spent[sensor] += time.thread_time() - cpu_s, time.perf_counter() - wall_s, len(events)
        yield spent


@app.command
def cost(count: int = 24) -> None:
    """Measure a whole sensor with its preset's noise beside that without, in one thread, step by step in turns.

    Both sensors see the same light frames, 1 ms apart, and read their events out:

        still      light that does not change at all: blocks of pixels that rest are skipped
        flicker    all light changes by 1e-4 in each step, and nothing fires but noise: no pixel is skipped
        moving     a grating of contrast 0.5 drifts by 200 pixels a second through a fifth of the rows

    A line has the medians over COUNT blocks of 64 steps of processor time (of the thread) and of wall time, the ratio
    of the medians with the quartiles of the blocks' own ratios, and the events a second of both. On a machine with
    other work only the ratios of processor times mean something.
    """
    make = partial(own_pixels, threads=1)
    for name, (preset, level) in COSTS.items():
        p = PRESETS[preset]
        quiet = dataclasses.replace(p, noise=dataclasses.replace(p.noise, rms=0.0))
        for scene, frames in lights(p, level).items():
            taken = blocks((Sensor(p, 1, make), Sensor(quiet, 1, make)), frames)
            spent = np.array(list(itertools.islice(taken, SETTLE_BLOCKS, SETTLE_BLOCKS + count)))
            _print_cost(f"{name:20} {scene:8}", spent)


def _print_cost(name: str, spent: npt.NDArray[np.float64]) -> None:
    """Print one line from (blocks, 2, 3)."""
    cpu, wall = (np.median(spent[:, :, k], axis=0) / STEPS * 1e6 for k in (0, 1))
    low, high = np.quantile(spent[:, 0, 0] / spent[:, 1, 0], (0.25, 0.75))
    rates = spent[:, :, 2].mean(0) / (STEPS * STEP_NS * 1e-9)
    print(
        f"{name} processor {cpu[0]:7.1f} and {cpu[1]:7.1f} us a step, ratio {cpu[0] / cpu[1]:.2f}"
        f" ({low:.2f} to {high:.2f}); wall ratio {wall[0] / wall[1]:.2f}; {rates[0]:.3g} and {rates[1]:.3g} events/s",
        flush=True,
    )


RATIOS = (1.6, 4.0, 7.15)
OVER = (0.35, 0.75)
EDGES_S = np.array([0.1, 1.0, 10.0])
CORNER_HZ = 150.0
TAU_S = 1 / (2 * math.pi * CORNER_HZ)
STEP = 0.01  # of a time constant
RISE_S, REST_S = 0.02, 0.04
RISE_FRAMES = 80
THRESHOLDS_PASSED = 3
P = SensorParameters(
    width=40,
    height=25,
    threshold_on=0.283,
    threshold_off=0.262,
    corner_hz_at_reference=math.inf,
    corner_max_hz=math.inf,
    leak_hz=0.0,
    refractory_us=3.4,
)
P_REFRACTORY = P.refractory_us * 1e-6 / TAU_S
MEAN = (P.threshold_on + P.threshold_off) / 2

Floats = npt.NDArray[np.float64]


@numba.njit(nogil=True)
def _followed(
    on: Floats, off: Floats, start: Floats, course: tuple[float, float, Floats], random: np.random.Generator
) -> Floats:
    """Return the events of each pixel before each end and after the last one, (pixels, ends).

    Lengths are in deviations of the noise, times in time constants. `start` is the signal above the first reference
    without noise; `course` has the slope of the signal, its time, and the ends of the windows: one begins where the one
    before ends, and events before the first end do not count.
    """
    slope, rise_end, ends = course
    counts = np.zeros((on.size, ends.size - 1))
    decay, kick = np.exp(-STEP), np.sqrt(-np.expm1(-2 * STEP))
    again = np.exp(-P_REFRACTORY)
    blind = np.sqrt(1 - again * again)
    for pixel in range(on.size):
        noise = random.normal()
        reference, t, v = -start[pixel], 0.0, noise
        while t < ends[-1]:
            noise = noise * decay + kick * random.normal()
            t += STEP
            w = noise + slope * min(t, rise_end)
            up, down, event = reference + on[pixel], reference - off[pixel], -1
            if w >= up or (v < up and random.random() < math.exp(-(up - v) * (up - w) / STEP)):
                event = 1
            elif w <= down or (v > down and random.random() < math.exp(-(v - down) * (w - down) / STEP)):
                event = 0
            if event >= 0:
                k = np.searchsorted(ends, t) - 1
                if 0 <= k < ends.size - 1:
                    counts[pixel, k] += 1
                t_reset = t + P_REFRACTORY
                signal = slope * min(t, rise_end)
                noise = ((up if event else down) - signal) * again + blind * random.normal()
                t = t_reset
                w = noise + slope * min(t, rise_end)
                reference = w
            v = w
    return counts


def noisy(ratio: float, **changes: Any) -> SensorParameters:
    """Return a sensor of which the mean threshold is `ratio` deviations of the noise."""
    return dataclasses.replace(P, noise=NoiseParameters(MEAN / ratio, CORNER_HZ), **changes)


def reference(p: SensorParameters, rise: float, begin_s: float) -> Floats:
    """Return the events of each pixel in each window, (pixels, 3); the light rises by `rise` ln units in `RISE_S`."""
    drawn, sigma = draw(p, 1), p.noise.rms
    start = drawn.phase * drawn.on if p.random_start else np.zeros(len(drawn.on))
    ends = np.concatenate([[begin_s], begin_s + EDGES_S]) / TAU_S
    slope = rise / sigma / (RISE_S / TAU_S)
    course = slope, RISE_S / TAU_S, ends
    return np.asarray(_followed(drawn.on / sigma, drawn.off / sigma, start / sigma, course, np.random.default_rng(3)))


def of_sensor(p: SensorParameters, rise: float, begin_s: float) -> Floats:
    """Return the same of the emulator's sensor."""
    sensor = Sensor(p, 1)
    times_s = [*(np.linspace(0, RISE_S, RISE_FRAMES + 1)[1:] if rise else ()), 0.03, 0.04, 0.06]
    times_s += [begin_s + t for t in (*EDGES_S, *range(1, 11)) if begin_s + t > times_s[-1]]
    dark = p.dark_current_relative

    def frame(t_s: float) -> LightFrame:
        current = math.exp(rise * (min(t_s / RISE_S, 1.0) - 1)) if rise else 1.0
        return LightFrame(round(t_s * 1e9), np.full((p.height, p.width), current - dark, np.float32))

    sensor.reset(frame(0.0))
    e = np.concatenate([*(sensor.expose(frame(t_s)) for t_s in sorted(set(times_s))), sensor.finish()])
    counts = np.zeros((p.width * p.height, len(EDGES_S)))
    t_s = e["t"] * 1e-6 - begin_s
    k = np.where(t_s > 0, np.searchsorted(EDGES_S, t_s), len(EDGES_S))
    inside = k < len(EDGES_S)
    np.add.at(counts, (e["y"][inside] * np.int64(p.width) + e["x"][inside], k[inside]), 1)
    return counts


@app.command
def points(pixels: int = 4000) -> None:
    """Compare point noise with a voltage that is followed in fine steps: events of a pixel from the first instant on.

    For mean thresholds of 1.6, 4 and 7.15 deviations of the noise, in three windows of time, the program prints the
    events of a pixel in the sensor and in the reference, and their quotient with its standard error,

        reset     after a start at random phases, in still light
        signal    after light has risen by some thresholds in 20 ms and stopped between two of them

    The reference adds an Ornstein-Uhlenbeck process of exact steps, a hundredth of its time constant long, to the
    logarithm of the light, and compares the sum with thresholds about the voltage of the last reset; a passage between
    two steps has the probability of a Brownian bridge. It shares with the emulator each pixel's thresholds and phase,
    and nothing else. Without a photoreceptor's corner the signal is the logarithm of the light, and the noise has its
    fixed pole alone.
    """
    height = max(1, pixels // P.width)
    print("start         threshold/sigma  window, s      sensor   reference  quotient")
    for ratio in RATIOS:
        cases = [("reset", noisy(ratio, height=height), 0.0, 0.0)]
        cases += [
            (
                f"signal +{over:g}",
                noisy(ratio, height=height, random_start=False, mismatch=0.0),
                P.threshold_on * (THRESHOLDS_PASSED + over),
                REST_S,
            )
            for over in OVER
        ]
        for name, p, rise, begin_s in cases:
            _print_points(f"{name:13} {ratio:<15g}", of_sensor(p, rise, begin_s), reference(p, rise, begin_s))


def _print_points(name: str, ours: Floats, true: Floats) -> None:
    begin_s = 0.0
    for k, end_s in enumerate(EDGES_S):
        means = [counts[:, k].mean() for counts in (ours, true)]
        errors = [counts[:, k].std() / math.sqrt(len(counts)) for counts in (ours, true)]
        line = f"{name}  {begin_s:g} to {end_s:<6g} {means[0]:10.5g} {means[1]:10.5g}"
        if min(means) > 0:
            quotient = means[0] / means[1]
            line += f"   {quotient:.3f} +- {quotient * math.hypot(errors[0] / means[0], errors[1] / means[1]):.3f}"
        print(line, flush=True)
        begin_s = end_s


if __name__ == "__main__":
    app()
