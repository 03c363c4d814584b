"""Fly the same starts with each navigation, and print what each is worth.

    python compare.py FOLDER --height 1500 --flights 100 --navigation blind altimeter events

A flight's number is its seed: start, errors of vehicle and sensors, ground (one of four, 3 degrees of slope,
boulders on 3 % of it), the Sun's elevation, the camera's thresholds. Flights that have a row in FOLDER/rows.jsonl
are not flown again; `--flights 0` only prints. Two programs with different `--first` can share a folder. Blind
flights and those with the altimeter alone need no camera (mission.py); the others are those of fly.py, over the
real serial line, bus and poses, one at a time.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from fly import ground_of
from mission import Bounds, fly_without_camera, judgement
from pilot import NAVIGATIONS, PilotSettings
from scipy.stats import binomtest

__all__ = ["rig_of", "row_of", "table"]

_HERE = Path(__file__).parent
_GROUNDS = (8, 3, 5, 11)
_LONGEST_S = 300
_MOST_WALL_S = 1800
_FIGURES = {
    "vertical_m_s": "down, m/s",
    "horizontal_m_s": "along the ground, m/s",
    "tilt_deg": "tilt, degrees",
    "place_m": "from the site, m",
}

Row = dict[str, Any]


def rig_of(seed: int) -> str:
    """Return the rig of a flight."""
    draw = np.random.default_rng([seed, 29])
    text = (_HERE / "landing.toml").read_text()
    for name, value in (
        ("seed = 8", f"seed = {draw.choice(_GROUNDS)}"),
        ("slope_deg = 1.0", "slope_deg = 3.0\nboulder_cover = 0.03"),
        ("sun_elevation_deg = 25.0", f"sun_elevation_deg = {draw.uniform(20, 35):.3f}"),
    ):
        text = re.sub(f"(?m)^{re.escape(name)}$", value, text)
    threshold = float(np.clip(draw.normal(0.283, 0.03), 0.2, 0.37))
    return text + f"\n[camera.sensor]\nthreshold_on = {threshold:.4f}\nthreshold_off = {threshold:.4f}\n"


def row_of(navigation: str, height_m: float, seed: int, folder: Path) -> Row:
    """Fly once; return its row. Raises RuntimeError for a flight without a verdict."""
    out = folder / f"{navigation}-{seed}"
    out.mkdir(parents=True, exist_ok=True)
    rig = out / "rig.toml"
    rig.write_text(rig_of(seed))
    began_s = time.monotonic()
    fly = _with_camera if "events" in NAVIGATIONS[navigation] else _without_camera
    judged = fly(navigation, height_m, seed, rig)
    row = {"navigation": navigation, "seed": seed, "height_m": height_m, "wall_s": round(time.monotonic() - began_s, 1)}
    return judged | row


def _without_camera(navigation: str, height_m: float, seed: int, rig: Path) -> Row:
    ground = ground_of(rig)
    end = fly_without_camera(height_m, seed, PilotSettings(navigation), ground)
    return {"touched": end.touched, "t_s": end.t_s, "why": list(end.why)} | judgement(end, ground)


def _with_camera(navigation: str, height_m: float, seed: int, rig: Path) -> Row:
    command = [sys.executable, str(_HERE / "fly.py"), "--height", str(height_m), "--seed", str(seed)]
    command += ["--rig", str(rig), "--navigation", navigation, "--out", str(rig.parent), "--longest-s", str(_LONGEST_S)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_MOST_WALL_S)
    file = rig.parent / "verdict.json"
    if not file.exists():
        raise RuntimeError(f"{navigation}, flight {seed} has no verdict: {done.stderr[-2000:]}")
    judged: Row = json.loads(file.read_text())
    return judged


def table(rows: Sequence[Row]) -> str:
    """Return the table of all navigations in the rows; quantiles are of the flights that touched down."""
    head = ["navigation", "good", "95 % interval", *_FIGURES.values(), "beyond a bound", "bad site"]
    lines = [head, ["---"] * len(head)]
    for navigation in NAVIGATIONS:
        chosen = [row for row in rows if row["navigation"] == navigation]
        lines += [_line(navigation, chosen)] if chosen else []
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _line(navigation: str, rows: Sequence[Row]) -> list[str]:
    good = sum(bool(row["soft"]) for row in rows)
    interval = binomtest(good, len(rows)).proportion_ci(0.95, "exact")
    landed = [row for row in rows if row["touched"]]
    cells = [_quantiles([row[name] for row in landed]) for name in _FIGURES]
    beyond = {name: sum(name in row["beyond"] for row in landed) for name in _FIGURES}
    words = [f"{name.rsplit('_', 1)[0].removesuffix('_m')} {count}" for name, count in beyond.items() if count]
    words += [f"not landed {len(rows) - len(landed)}"] if len(landed) < len(rows) else []
    share = f"{100 * interval.low:.0f} to {100 * interval.high:.0f} %"
    bad_sites = sum(not row["site_good"] for row in landed)
    return [navigation, f"{good} of {len(rows)}", share, *cells, ", ".join(words), str(bad_sites)]


def _quantiles(values: Sequence[float]) -> str:
    if not values:
        return ""
    middle, high, most = np.quantile(values, [0.5, 0.9, 1.0])
    return f"{middle:.2f} / {high:.2f} / {most:.2f}"


def _flown(file: Path) -> list[Row]:
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def main(print_line: Callable[[str], None] = print) -> None:
    """Fly what is missing, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--height", type=float, default=1500.0)
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--first", type=int, default=1, help="first seed: two programs can share the work")
    parser.add_argument("--navigation", nargs="+", choices=NAVIGATIONS, default=["blind", "altimeter", "events"])
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    file = arguments.folder.resolve() / "rows.jsonl"
    known = {(row["navigation"], row["seed"], row["height_m"]) for row in _flown(file)}
    for seed in range(arguments.first, arguments.first + arguments.flights):
        for navigation in arguments.navigation:
            if (navigation, seed, arguments.height) in known:
                continue
            row = row_of(navigation, arguments.height, seed, file.parent)
            with file.open("a") as rows:
                print(json.dumps(row), file=rows)
            print(f"{navigation} {seed}: {'good' if row['soft'] else row['beyond']}", file=sys.stderr, flush=True)
    chosen = [row for row in _flown(file) if row["height_m"] == arguments.height]
    bounds = Bounds()
    print_line(f"From {arguments.height:g} m; median / 90 % / most of each figure; bounds: {bounds}")
    print_line(table(chosen))


if __name__ == "__main__":
    main()
