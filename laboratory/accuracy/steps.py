"""Events of a rig at several steps against those at a shorter one: the error of the interpolation alone.

    python -m laboratory.accuracy.steps RIG SECONDS REFERENCE_US STEP_US ...

Leak and noise are off. Light is drawn by the same scene at every step, so its own errors are not in these numbers; see
`evstim accuracy rendering` for those. False and missed events are those by which the numbers of events of a pixel and
polarity differ; times are compared where the numbers are equal. Processor time is that of a whole run without links.
"""

from __future__ import annotations

import dataclasses
import sys
import time

import numpy as np
import numpy.typing as npt

import evstim
from emulator.rig.loading import Rig, load_rig
from emulator.run.tuning import quiet
from laboratory.accuracy.scores import Stream


def main(rig: str, seconds: str, reference_us: str, *steps_us: str) -> None:
    """Print a line for each step; the arguments are those of the command."""
    true, _ = events_at(load_rig(rig), float(seconds), int(reference_us))
    print(f"{rig}: {len(true)} events at steps of {reference_us} us")
    for step_us in steps_us:
        found, spent_s = events_at(load_rig(rig), float(seconds), int(step_us))
        wrong, errors_us = difference(true, found)
        t50_us, t95_us = np.quantile(errors_us, (0.5, 0.95))
        print(
            f"step {step_us} us: false + missed {100 * wrong / len(true):.2f} %, t50 {t50_us:.0f} us,"
            f" t95 {t95_us:.0f} us, processor time {spent_s:.3f} s for a second of stream"
        )


def events_at(rig: Rig, seconds: float, step_us: int) -> tuple[Stream, float]:
    """Return the events of a run without links, ON and OFF of a pixel apart, and its processor time, s per second.

    Time is counted from the first events on.
    """
    camera = dataclasses.replace(rig.camera, sensor=quiet(rig.camera.sensor))
    run = dataclasses.replace(rig.run, step_us=step_us, lead_us=2 * step_us)
    alone = dataclasses.replace(rig, links=(), camera=camera, run=run)
    batches, first_s, first_us = [], None, 0
    with evstim.run(alone, seconds=seconds, seed=7, pace="free") as events:
        for batch in events:
            if first_s is None:
                first_s, first_us = time.process_time(), int(batch["t"][0])
            batches.append(batch.copy())
        spent_s = time.process_time() - (first_s or 0.0)
    every, (width, height) = np.concatenate(batches), rig.camera.size
    place = 2 * (every["y"].astype(np.int64) * width + every["x"]) + every["on"]
    stream = Stream.of(every["t"].astype(np.float64), place, every["on"], 2 * width * height)
    return stream, spent_s / (seconds - first_us * 1e-6)


def difference(true: Stream, found: Stream) -> tuple[int, npt.NDArray[np.float64]]:
    """Return the number of false and missed events, and the errors of time of the others, us."""
    equal = true.counts == found.counts
    errors_us = np.abs(true.t_us[equal[true.pixel]] - found.t_us[equal[found.pixel]])
    return int(np.abs(true.counts - found.counts).sum()), errors_us


if __name__ == "__main__":
    if len(sys.argv) < 5:
        sys.exit(__doc__)
    main(*sys.argv[1:])
