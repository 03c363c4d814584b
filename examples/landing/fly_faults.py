"""Fly a landing with each fault, one after the other, and print a table of the results.

    python fly_faults.py [--out faults] [NAME ...]      all of FLIGHTS, or those named

Each flight has a folder of its own, as from fly.py; one that has its verdict there is not flown again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

_HERE = Path(__file__).parent
_ALL = "--navigation given --height 20 --seed 3 --longest-s 32 --answer-s 60"
FLIGHTS = {
    "none": "",
    "lost_bytes": "--table faults_of_links/lost_bytes.toml",
    "bit_flips": "--table faults_of_links/bit_flips.toml",
    "unplugged": "--table faults_of_links/unplugged.toml",
    "stuck_high": "--table faults_of_links/stuck.toml",
    "stuck_low": "--table faults_of_links/stuck_low.toml",
    "storm": "--table faults_of_links/storm.toml",
    "frames_lost": "--fault lose@0=0.05",
    "babbling": "--table faults_of_links/babbling.toml",
    "dead_bus": "--table faults_of_links/dead_bus.toml",
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
"""Name of each flight and its arguments of fly.py."""

_HEAD = "| flight | ended | error of the divergence, median / 90 % | verdict |\n|---|---|---|---|"


def fly(name: str, out: Path) -> dict[str, Any]:
    """Return the verdict of a flight, flown now unless its folder has one; raises RuntimeError."""
    file = out / name / "verdict.json"
    if not file.exists():
        command = [sys.executable, "fly.py", *_ALL.split(), *FLIGHTS[name].split(), "--out", str(file.parent)]
        ended = subprocess.run(command, cwd=_HERE, capture_output=True, text=True, check=False)
        if not file.exists():
            raise RuntimeError(f"{name}: {ended.stderr}")
    judged: dict[str, Any] = json.loads(file.read_text())
    return judged


def line(name: str, judged: dict[str, Any]) -> str:
    """Return a line of the table."""
    title = f"{name}: `{FLIGHTS[name]}`" if FLIGHTS[name] else name
    ended = f"{judged['vertical_m_s']:.2f} m/s" if judged["touched"] else f"not landed, {judged['height_m']:.1f} m up"
    error = (
        f"{judged['error_median'] * 100:.1f} % / {judged['error_p90'] * 100:.1f} %" if "error_median" in judged else ""
    )
    return " ".join(f"| {title} | {ended} | {error} | {'; '.join(judged['why'])} |".split())


def main() -> None:
    """Fly and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(FLIGHTS))
    parser.add_argument("--out", type=Path, default=Path("faults"))
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(FLIGHTS):
        parser.error(f"no such flight: {', '.join(sorted(unknown))}")
    print(_HEAD)
    for name in arguments.names or FLIGHTS:
        print(line(name, fly(name, arguments.out.resolve())), flush=True)


if __name__ == "__main__":
    main()
