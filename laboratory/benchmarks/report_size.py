"""Size of the report of a long run: a slow checkerboard at pace "free", read by the loopback host.

    python -m laboratory.benchmarks.report_size [HOURS]

HOURS (2 by default) are hours of the camera's time. The bytes of each file of the report are printed, and those of a
run a hundredth as long before them. Exit code 1 where `report.html` is 5 MB or more.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

MOST_BYTES = 5_000_000
RIG = """
title = "hours of a slow checkerboard"
scene = { kind = "checkerboard", square_px = 20.0, speed_px_s = 0.5, direction_deg = 30.0 }
camera = { model = "davis346" }
run = { pace = "free", step_us = 50000, seed = 1 }
links = [{ kind = "loopback" }]
"""
RUN = [sys.executable, "-c", "from emulator.cli import main; main()", "run"]


def measured(hours: float, folder: Path) -> dict[str, int]:
    """Run for so long, print what was run, and return the bytes of each file of its report."""
    rig, report = folder / "long.toml", folder / f"report-{hours:g}"
    rig.write_text(RIG, encoding="utf-8")
    command = [*RUN, str(rig), "--seconds", f"{hours * 3600:g}", "--report", str(report), "--json"]
    start_s = time.monotonic()
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    summary = json.loads(done.stdout.splitlines()[-1])
    sizes = {path.name: path.stat().st_size for path in sorted(report.iterdir())}
    took_s, load = time.monotonic() - start_s, os.getloadavg()[0]
    sys.stdout.write(f"{hours:g} h of device time in {took_s:.0f} s, load {load:.1f}: {summary['events']}; {sizes}\n")
    sys.stdout.flush()
    return sizes


def main(hours: float = 2.0) -> int:
    """Measure a short and a long run."""
    with tempfile.TemporaryDirectory() as folder:
        measured(hours / 100, Path(folder))
        sizes = measured(hours, Path(folder))
    return int(sizes["report.html"] >= MOST_BYTES)


if __name__ == "__main__":
    sys.exit(main(*map(float, sys.argv[1:])))
