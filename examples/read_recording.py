"""Read a recording and print its rates: `python read_recording.py FILE`.

FILE is what `evstim run RIG --record FILE` or `evstim listen --record FILE` wrote, in any format. Without one, a tenth
of a second of the rig 'loopback' is recorded first.
"""

from __future__ import annotations

import sys

import numpy as np

import evstim

__all__ = ["main"]


def main(path: str | None = None) -> float:
    """Print the content of the recording; return its mean event rate, events/s."""
    if path is None:
        path = "recording.npz"
        with evstim.run("loopback", seconds=0.1, pace="free", record=path) as run:
            run.wait()
    events = evstim.read_events(path)
    if len(events) < 2:
        print(f"{path}: {len(events)} events")
        return 0.0
    seconds = float(events["t"][-1] - events["t"][0]) * 1e-6
    rate = len(events) / seconds
    pixels, counts = np.unique(events[["x", "y"]], return_counts=True)
    busiest = pixels[counts.argmax()]
    print(f"{path}: {len(events)} events in {seconds:.3f} s, {rate:.0f} a second, {events['on'].mean():.0%} ON")
    print(f"{len(pixels)} pixels fired; most often x = {busiest['x']}, y = {busiest['y']}: {counts.max()} times")
    return rate


if __name__ == "__main__":
    main(*sys.argv[1:])
