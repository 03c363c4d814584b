"""Fly many landings, and print a table: the same starts with each navigation, or one landing with each fault.

    python compare.py FOLDER --height 1500 --flights 100 --navigation blind altimeter events
    python compare.py FOLDER --faults [NAME ...]

A flight's number is its seed: start, errors of vehicle and sensors, ground, the Sun's elevation, the camera's
thresholds. Flights that have a row in FOLDER/rows.jsonl, or a verdict in FOLDER/NAME, are not flown again; `--flights
0` only prints. Blind flights and those with the altimeter alone need no camera; the others are those of fly.py, over
the real serial line, bus and poses, one at a time.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from fly import ground_of
from pilot import NAVIGATIONS
from report import BOUNDS, FIGURES, SITE_BOUNDS, judgement
from scipy.stats import binomtest
from spacecraft import fly_without_camera

_HERE = Path(__file__).parent
_GROUNDS = (8, 3, 5, 11)
_MOST_WALL_S = 1800
_ALL = "--navigation given --height 20 --seed 3 --longest-s 32 --answer-s 60"
_TABLES = ["lost_bytes", "bit_flips", "unplugged", "stuck", "stuck_low", "storm", "babbling", "dead_bus"]
FAULTS = {
    "none": "",
    **{name: f"--table faults_of_links/{name}.toml" for name in _TABLES},
    "frames_lost": "--fault lose@0=0.05",
    "nan": "--fault nan@5+1",
    "nan_to_the_end": "--fault nan@5",
    "poses_stop": "--fault stop@5+1",
    "poses_stop_to_the_end": "--fault stop@5",
    "poses_backwards": "--fault backwards@5+1",
    "poses_backwards_to_the_end": "--fault backwards@5",
    "crash": "--fault crash@5",
    "crash_near_the_ground": "--fault crash@19",
    "hang": "--fault hang@5 --answer-s 20",
}
"""Name of each flight with a fault, and its arguments of fly.py."""

Row = dict[str, Any]


def flown(out: Path, arguments: Sequence[object]) -> Row:
    """Return the verdict of a flight of fly.py into a folder; raises RuntimeError for one without a verdict."""
    command = [sys.executable, "fly.py", *map(str, arguments), "--out", str(out)]
    ended = subprocess.run(command, cwd=_HERE, capture_output=True, text=True, check=False, timeout=_MOST_WALL_S)
    file = out / "verdict.json"
    if not file.exists():
        raise RuntimeError(f"{out.name} has no verdict: {ended.stderr[-2000:]}")
    judged: Row = json.loads(file.read_text())
    return judged


def rig_of(seed: int) -> str:
    """Return the rig of a flight: one of four grounds with slopes of 3 degrees and boulders on 3 % of it."""
    draw = np.random.default_rng([seed, 29])
    text = (_HERE / "landing.toml").read_text()
    text = text.replace("\nseed = 8\n", f"\nseed = {draw.choice(_GROUNDS)}\n")
    text = text.replace("slope_deg = 1.0", "slope_deg = 3.0\nboulder_cover = 0.03")
    text = text.replace("sun_elevation_deg = 25.0", f"sun_elevation_deg = {draw.uniform(20, 35):.3f}")
    threshold = float(np.clip(draw.normal(0.283, 0.03), 0.2, 0.37))
    return text + f"\n[camera.sensor]\nthreshold_on = {threshold:.4f}\nthreshold_off = {threshold:.4f}\n"


def row_of(navigation: str, height_m: float, seed: int, folder: Path) -> Row:
    """Fly a start once with a navigation; return its row. Raises RuntimeError for a flight without a verdict."""
    out = folder / f"{navigation}-{seed}"
    out.mkdir(parents=True, exist_ok=True)
    rig, began_s = out / "rig.toml", time.monotonic()
    rig.write_text(rig_of(seed))
    if "events" in NAVIGATIONS[navigation]:
        options = ["--height", height_m, "--seed", seed, "--rig", rig, "--longest-s", 300, "--navigation", navigation]
        judged = flown(out, options)
    else:
        ground = ground_of(rig)
        end = fly_without_camera(height_m, seed, navigation, ground)
        judged = {"touched": end.touched, "t_s": end.t_s, "why": list(end.why)} | judgement(end, ground)
    wall_s = round(time.monotonic() - began_s, 1)
    return judged | {"navigation": navigation, "seed": seed, "height_m": height_m, "wall_s": wall_s}


def table(rows: Sequence[Row]) -> str:
    """Return the table of all navigations in the rows; quantiles are of the flights that touched down."""
    lines = [["navigation", "good", "95 % interval", *FIGURES.values(), "beyond a bound", "bad site"]]
    lines.append(["---"] * len(lines[0]))
    for navigation in NAVIGATIONS:
        flights = [row for row in rows if row["navigation"] == navigation]
        if not flights:
            continue
        good = sum(bool(row["soft"]) for row in flights)
        interval = binomtest(good, len(flights)).proportion_ci(0.95, "exact")
        landed = [row for row in flights if row["touched"]]
        cells = [f"{good} of {len(flights)}", f"{100 * interval.low:.0f} to {100 * interval.high:.0f} %"]
        for name in FIGURES:
            quantiles = np.quantile([row[name] for row in landed], [0.5, 0.9, 1.0]) if landed else []
            cells.append(" / ".join(f"{quantile:.2f}" for quantile in quantiles))
        beyond = {name.partition("_")[0]: sum(name in row["beyond"] for row in landed) for name in FIGURES}
        beyond["not landed"] = len(flights) - len(landed)
        bad_sites = sum(not row["site_good"] for row in landed)
        words = ", ".join(f"{name} {count}" for name, count in beyond.items() if count)
        lines.append([navigation, *cells, words, str(bad_sites)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def fault_line(name: str, folder: Path) -> str:
    """Return a line of the table of faults, of a flight that is flown now unless its folder has a verdict."""
    file = folder / name / "verdict.json"
    judged = json.loads(file.read_text()) if file.exists() else flown(file.parent, f"{_ALL} {FAULTS[name]}".split())
    title = f"{name}: `{FAULTS[name]}`" if FAULTS[name] else name
    ended = f"{judged['vertical_m_s']:.2f} m/s" if judged["touched"] else f"not landed, {judged['height_m']:.1f} m up"
    errors = [f"{judged[key] * 100:.1f} %" for key in ("error_median", "error_p90") if key in judged]
    return " ".join(f"| {title} | {ended} | {' / '.join(errors)} | {'; '.join(judged['why'])} |".split())


def main() -> None:
    """Fly what is missing, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--height", type=float, default=1500.0)
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--navigation", nargs="+", choices=NAVIGATIONS, default=["blind", "altimeter", "events"])
    parser.add_argument("--faults", nargs="*", choices=list(FAULTS), metavar="NAME", help="all, or these")
    options = parser.parse_args()
    folder = options.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if options.faults is not None:
        print("| flight | ended | error of the divergence, median / 90 % | verdict |\n|---|---|---|---|")
        for name in options.faults or FAULTS:
            print(fault_line(name, folder))
        return
    file = folder / "rows.jsonl"
    file.touch()
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    flights = {(row["navigation"], row["seed"], row["height_m"]) for row in rows}
    for seed in range(1, options.flights + 1):
        for navigation in options.navigation:
            if (navigation, seed, options.height) not in flights:
                rows.append(row := row_of(navigation, options.height, seed, folder))
                with file.open("a") as more:
                    print(json.dumps(row), file=more)
                print(f"{navigation} {seed}: {'good' if row['soft'] else row['beyond']}", file=sys.stderr, flush=True)
    print(f"From {options.height:g} m; median / 90 % / most of each figure; bounds: {BOUNDS | SITE_BOUNDS}")
    print(table([row for row in rows if row["height_m"] == options.height]))


if __name__ == "__main__":
    main()
