"""Events of a rig at several steps against those at a shorter one: the error of the interpolation alone.

    python -m laboratory.benchmarks.steps RIG SECONDS REFERENCE_US STEP_US ...

Leak and noise are off. Light is drawn by the same scene at every step, so its own errors are not in these numbers; see
`evstim accuracy rendering` for those. False and missed events are those by which the numbers of events of a pixel and
polarity differ; times are compared where the numbers are equal. Processor time is that of a whole run without links.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

import evstim
from emulator.rig.loading import Rig, load_rig
from laboratory.accuracy.rendering import quiet


class Sequences(NamedTuple):
    """Events sorted by pixel and polarity: that of each event, its time in us, (n,) int64 each."""

    place: npt.NDArray[np.int64]
    t_us: npt.NDArray[np.int64]


def main(rig: str, seconds: str, reference_us: str, *steps_us: str) -> None:
    """Print a line for each step; the arguments are those of the command."""
    true, _ = events_at(load_rig(rig), float(seconds), int(reference_us))
    print(f"{rig}: {len(true.place)} events at steps of {reference_us} us")
    for step_us in steps_us:
        found, spent_s = events_at(load_rig(rig), float(seconds), int(step_us))
        wrong, errors_us = difference(true, found)
        t50_us, t95_us = np.quantile(errors_us, (0.5, 0.95))
        print(
            f"step {step_us} us: false + missed {100 * wrong / len(true.place):.2f} %, t50 {t50_us:.0f} us,"
            f" t95 {t95_us:.0f} us, processor time {spent_s:.3f} s for a second of stream"
        )


def events_at(rig: Rig, seconds: float, step_us: int) -> tuple[Sequences, float]:
    """Return the events of a run without links, and its processor time after the first events, s per second."""
    camera = dataclasses.replace(rig.camera, sensor=quiet(rig.camera.sensor))
    run = dataclasses.replace(rig.run, step_us=step_us, lead_us=2 * step_us)
    batches, first_s, first_us = [], None, 0
    with evstim.run(
        dataclasses.replace(rig, links=(), camera=camera, run=run), seconds=seconds, seed=7, pace="free"
    ) as events:
        for batch in events:
            if first_s is None:
                first_s, first_us = time.process_time(), int(batch["t"][0])
            batches.append(batch.copy())
        spent_s = time.process_time() - (first_s or 0.0)
    every = np.concatenate(batches)
    place = (every["y"].astype(np.int64) << 17) | (every["x"].astype(np.int64) << 1) | every["on"]
    order = np.lexsort((every["t"], place))
    return Sequences(place[order], every["t"][order].astype(np.int64)), spent_s / (seconds - first_us * 1e-6)


def difference(true: Sequences, found: Sequences) -> tuple[int, npt.NDArray[np.int64]]:
    """Return the number of false and missed events, and the errors of time of the others, us."""
    places = np.union1d(true.place, found.place)
    true_begin, found_begin = (np.searchsorted(one.place, places) for one in (true, found))
    true_count, found_count = (np.searchsorted(one.place, places, "right") for one in (true, found))
    true_count, found_count = true_count - true_begin, found_count - found_begin
    equal = true_count == found_count
    within = _within(true_count[equal])
    pairs = [begin[equal].repeat(true_count[equal]) + within for begin in (true_begin, found_begin)]
    return int(np.abs(true_count - found_count).sum()), np.abs(true.t_us[pairs[0]] - found.t_us[pairs[1]])


def _within(counts: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return 0, 1, ... for each count in turn."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)


if __name__ == "__main__":
    if len(sys.argv) < 5:
        sys.exit(__doc__)
    main(*sys.argv[1:])
