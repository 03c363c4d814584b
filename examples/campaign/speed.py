"""A program under test: finds the speed of a pattern that moves to the right, by contrast maximisation.

python speed.py EVENTS.npz TRUE_SPEED RESULT.json
"""

import json
import sys

import numpy as np
import numpy.typing as npt

Events = npt.NDArray[np.void]
Speeds = npt.NDArray[np.float64]

RANGE_PX_S = 5.0, 500.0


def contrast(events: Events, speed_px_s: float) -> float:
    """Return the sharpness of the edges when every event is moved back to the place of its edge at time zero."""
    x = events["x"] - speed_px_s * events["t"] * 1e-6
    counts = np.bincount((x - x.min()).astype(int))
    return float(np.sum(counts.astype(float) ** 2))


def best(events: Events, candidates: Speeds) -> float:
    """Return the candidate with the sharpest edges."""
    return float(candidates[int(np.argmax([contrast(events, speed) for speed in candidates]))])


def speed_of(events: Events) -> float:
    """Return the speed in pixels a second; events of one polarity, because edges of both could overlap."""
    events = events[events["on"]]
    rough = best(events, np.geomspace(*RANGE_PX_S, 200))
    return best(events, np.linspace(0.97 * rough, 1.03 * rough, 61))


def main(recording: str, true_speed: str, result: str) -> int:
    """Write the speed and its error, as a share of the true speed."""
    events = np.load(recording)["events"]
    if not np.count_nonzero(events["on"]):
        return 1
    found = speed_of(events)
    values = {"speed_px_s": found, "error": abs(found / float(true_speed) - 1), "events": len(events)}
    with open(result, "w") as file:
        json.dump(values, file)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
