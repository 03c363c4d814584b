"""Error of a flight's divergence: the computer's estimate beside the vehicle's speed over its height."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np

__all__ = ["divergence_errors"]

_LEAST_M = 3.0  # nearer, the ground in view is no longer that below


def divergence_errors(out: Path) -> dict[str, float]:
    """Return median and 90 % of the absolute relative error of the divergence, its median with its sign, and losses.

    Each accepted motion counts once; its truth is speed over height above the ground below, at its time.
    """
    truth = np.genfromtxt(out / "truth.csv", delimiter=",", names=True)
    rows = [json.loads(line) for line in (out / "computer.jsonl").read_text().splitlines()]
    seen = {row["at_s"]: row["down_1_s"] for row in rows if math.isfinite(row.get("gain", math.inf)) and "at_s" in row}
    at_s, down = np.array(list(seen)), np.array(list(seen.values()))
    height_m = np.interp(at_s, truth["t_s"], truth["z_m"] - truth["ground_m"])
    wanted = height_m > _LEAST_M
    if not wanted.any():
        return {}
    speed_m_s = -np.interp(at_s, truth["t_s"], truth["vz_m_s"])
    error = (down * height_m / speed_m_s - 1)[wanted]
    low, high = np.percentile(np.abs(error), [50, 90])
    share = float(np.mean([row["lost"] for row in rows]))
    return {"error_median": float(low), "error_p90": float(high), "bias": float(np.median(error)), "lost_share": share}


if __name__ == "__main__":
    print(json.dumps(divergence_errors(Path(sys.argv[1])), indent=1))
