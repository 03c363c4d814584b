#!/usr/bin/env python3
"""Ratchet of speed: processor time of a step, by part, which may only get better. `speed.toml` has the numbers.

    speed.py                   four rigs as shipped, over a calibration in the same process: [quotients], for CI
    speed.py --base [NAME...]  rigs, by default those in [ratios], in turns with the commit `base`; minutes
    speed.py --base --all      all rigs that differ, at both sizes; half an hour
    speed.py --measure NAME... print the measurement of these rigs, "eros" or "eros@1280x720", as JSON

A quotient is the median processor time of a step over that of fixed loops, both vector and scalar; one fails beyond 1.5
times its number, so that neither another machine nor a busy one fails it, and a factor of two does. A ratio is the
median of a step here over that of the base commit on the same machine in the same minutes, and fails beyond 1.08 times
its number. What fails is measured once more. `--toml` prints the numbers as they are; they may only fall, in the commit
that makes them fall.

Parts: "drawing" the light, the mean of steps, as only some of them need an exact drawing, "pixels" with noise,
"read-out" with all that follows the pixels. One thread computes at a time.
"""

from __future__ import annotations

import dataclasses
import json
import os
import statistics
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RIGS = ("eros", "itokawa", "checkerboard", "stars-evk4")
STEPS, LEAST_STEPS, MOST_S = 24, 8, 8.0
"""Steps that are measured after the first three: their number, and how many at least where they take over MOST_S;
multiples of four, as every fourth step may need a drawing."""
TURNS = 3
QUOTIENT_SLACK, RATIO_SLACK = 1.5, 1.08
LEAST_QUOTIENT = 0.1
"""Quotients below it, some 0.5 ms of a step, are not judged: they are the overhead of calls."""

Parts = dict[str, float]
"""Processor seconds of a step, or a quotient, by "RIG PART"."""


def calibration() -> Callable[[], float]:
    """Return a function that gives the processor seconds of fixed loops: one over arrays, one in scalars."""
    import numpy as np
    from numba import njit

    @njit(nogil=True)
    def loops(values: Any, rounds: int) -> float:
        total = 0.0
        for _ in range(rounds):
            for index in range(values.size):  # a vector loop
                values[index] = values[index] * 0.999 + 0.001
            state = 1.0
            for index in range(values.size // 8):  # each value waits for the one before
                state = state * 0.5 + values[index] / (1.0 + state)
            total += state
        return total

    values = np.ones(1 << 16)
    loops(values, 1)

    def seconds() -> float:
        began_s = time.process_time()
        loops(values, 40)
        return time.process_time() - began_s

    return seconds


def measured(names: Iterable[str]) -> Parts:
    """Return the processor seconds of a step of rigs by part, and those of the calibration beside each rig."""
    seconds = calibration()
    result: Parts = {}
    for name in names:
        before = [seconds() for _ in range(5)]
        result |= {f"{name} {part}": value for part, value in step_of(name).items()}
        result[f"{name} calibration"] = statistics.median([*before, *(seconds() for _ in range(5))])
    return result


def step_of(name: str) -> Parts:
    """Return the processor seconds of a step of a rig, by part: the median, of drawing the mean."""
    from emulator.light import SceneFrames
    from emulator.run.assembly import build_frames, build_scene, build_sensor, planned_sensor

    rig = rig_of(name)
    rig = dataclasses.replace(rig, run=dataclasses.replace(rig.run, threads=1))
    taken: dict[str, list[float]] = {"drawing": [], "pixels": [], "read-out": []}
    with build_scene(rig) as scene:
        frames: SceneFrames = build_frames(rig, scene)
        sensor: Any = build_sensor(rig, planned_sensor(rig, scene))
        pixels_s = [0.0]
        solve = sensor.pixels.step

        def timed(frame: Any) -> Any:
            began_s = time.process_time()
            crossings = solve(frame)
            pixels_s[0] += time.process_time() - began_s
            return crossings

        sensor.pixels.step = timed
        sensor.reset(frames.draw(0))
        began_s = time.process_time()
        for number in range(1, STEPS + 4):
            if number > LEAST_STEPS and number % 4 == 0 and time.process_time() - began_s > MOST_S:
                break
            t0_s = time.process_time()
            frame = frames.draw(number * rig.run.step_us * 1000)
            if hasattr(scene, "wait"):  # for drawings that another thread makes ahead
                scene.wait()
            t1_s, pixels_s[0] = time.process_time(), 0.0
            sensor.expose(frame)
            rest_s = time.process_time() - t1_s - pixels_s[0]
            if number > 3:
                for part, value in zip(taken, (t1_s - t0_s, pixels_s[0], rest_s), strict=True):
                    taken[part].append(value)
    by_part = {part: statistics.median(values) for part, values in taken.items()}
    return by_part | {"drawing": statistics.mean(taken["drawing"])}


def rig_of(name: str) -> Any:
    """Return a shipped rig, as it is or at a size of `laboratory.realtime`."""
    from emulator.rig.loading import load_rig
    from laboratory.realtime.variants import SIZES, variant_of

    rig, _, size_name = name.partition("@")
    if not size_name:
        return load_rig(rig)
    return variant_of(rig, next(size for size in SIZES if size.name == size_name)).loaded()


def run_of(tree: Path, names: Iterable[str]) -> Parts:
    """Return the measurement of rigs by the code of a tree, in a process of its own."""
    command = [sys.executable, str(Path(__file__)), "--measure", *names]
    output = subprocess.run(command, cwd=tree, env=environment(tree), check=True, stdout=subprocess.PIPE).stdout
    return dict(json.loads(output))


def environment(tree: Path) -> dict[str, str]:
    """Return the environment in which Python imports the packages of a tree."""
    return {**os.environ, "PYTHONPATH": str(tree)}


def quotients(names: Iterable[str]) -> Parts:
    """Return the quotients of rigs."""
    seconds = run_of(ROOT, names)
    parts = {key: value for key, value in seconds.items() if not key.endswith(" calibration")}
    return {key: value / seconds[f"{key.partition(' ')[0]} calibration"] for key, value in parts.items()}


def ratios(base: Path, names: Iterable[str]) -> Parts:
    """Return the medians of ratios to the tree of the base commit, measured in turns."""
    found: dict[str, list[float]] = {}
    for name in names:
        for turn in range(TURNS):
            here, there = run_of(ROOT, [name]), run_of(base, [name])
            for key in here:
                found.setdefault(key, []).append(here[key] / there[key])
            print(f"{name}: turn {turn + 1} of {TURNS}", file=sys.stderr)
    return {key: statistics.median(values) for key, values in found.items() if not key.endswith(" calibration")}


def base_tree(commit: str) -> Path:
    """Return a tree of the base commit with kernels of its own, made where it is not there."""
    tree = ROOT / ".cache" / f"base-{commit[:8]}"
    if not tree.exists():
        subprocess.run(["git", "worktree", "add", "--detach", str(tree), commit], cwd=ROOT, check=True)
        prepare = [sys.executable, "-m", "evstim", "doctor", "--prepare"]
        subprocess.run(prepare, cwd=tree, env=environment(tree), check=True)
    return tree


def slower(found: Parts, numbers: Parts, slack: float) -> dict[str, str]:
    """Return a sentence for each part that is slower than its number allows, by its key; one without a number is."""
    bounds = {key: max(slack * numbers[key], LEAST_QUOTIENT) if key in numbers else 0.0 for key in found}
    return {
        key: f"{key}: {value:.3g}, speed.toml has {numbers.get(key, 0.0):.3g} and allows {bounds[key]:.3g}"
        for key, value in found.items()
        if value > bounds[key]
    }


def main(arguments: list[str]) -> int:
    """Do what the arguments request; return the exit code."""
    if "--measure" in arguments:
        sys.path.insert(0, os.getcwd())
        print(json.dumps(measured(arguments[1:])))
        return 0
    table = tomllib.loads((ROOT / "speed.toml").read_text())
    if "--base" in arguments:
        from emulator.rig.loading import shipped_rigs
        from laboratory.realtime.variants import SIZES, distinct

        tree = base_tree(table["base"])
        given = [name for name in arguments if not name.startswith("-")]
        measured_before = dict.fromkeys(key.partition(" ")[0] for key in table["ratios"])
        names = given or [*measured_before]
        if "--all" in arguments:
            names = [f"{rig}@{size.name}" for rig in distinct(shipped_rigs()) for size in SIZES]
        section, slack, measure = "ratios", RATIO_SLACK, lambda wanted: ratios(tree, wanted)
    else:
        names, section, slack, measure = [*RIGS], "quotients", QUOTIENT_SLACK, quotients
    found = measure(names)
    if "--toml" in arguments:
        print("\n".join([f"[{section}]", *(f'"{key}" = {value:.3g}' for key, value in found.items())]))
        return 0
    failed = slower(found, table.get(section, {}), slack)
    if failed:  # a machine that was busy for a moment
        again = measure(sorted({key.partition(" ")[0] for key in failed}))
        failed = slower({key: min(again[key], found[key]) for key in failed}, table.get(section, {}), slack)
    for key, value in found.items():
        print(f"{value:9.3g}  {table.get(section, {}).get(key, 0.0):9.3g} in speed.toml  {key}")
    print("\n".join([*failed.values(), f"{len(failed)} parts are slower than speed.toml allows"]))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
