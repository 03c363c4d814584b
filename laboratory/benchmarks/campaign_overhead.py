"""Cost of `evstim campaign` beside its runs.

    python -m laboratory.benchmarks.campaign_overhead [RUNS] [MS] [WORKERS]

CPU time of all processes of the command, start and report included, less that of the runs (`machine.cpu_s` of each
row), over the latter: a busy machine does not change it much. MS is stream time of a run of 32 x 32 pixels.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from emulator.campaign.report import numbers
from emulator.campaign.table import read_rows

CAMPAIGN = """
rig = "checkerboard"
count = {runs}
[set]
links = []
run = {{seconds = {seconds}, pace = "free"}}
camera.sensor = {{width = 32, height = 32}}
[[parameters]]
key = "scene.speed_px_s"
kind = "log-uniform"
low = 30
high = 600
"""
COMMAND = [sys.executable, "-c", "from emulator.cli import main; main()", "--quiet", "campaign"]


def cost(runs: int, seconds: float, workers: int) -> tuple[float, float, float]:
    """Return the CPU time of a campaign, that of its runs, and its wall time; s."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "overhead.toml")
        file.write_text(CAMPAIGN.format(runs=runs, seconds=seconds))
        begun_s = time.monotonic()
        process = subprocess.Popen([*COMMAND, str(file), "--workers", str(workers)], stdout=subprocess.DEVNULL)
        _, code, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(code)
        assert process.returncode == 0, "the campaign did not end well, see above"
        wall_s = time.monotonic() - begun_s
        rows = read_rows(file.with_suffix("") / "rows")
    return used.ru_utime + used.ru_stime, float(np.sum(numbers(rows, "machine.cpu_s"))), wall_s


def main(runs: int = 1000, ms: int = 100, workers: int = 2) -> None:
    """Measure a campaign, and one of as many runs as workers: what is paid once."""
    whole_s, runs_s, wall_s = cost(runs, ms * 1e-3, workers)
    once_s, few_s, _ = cost(workers, ms * 1e-3, workers)
    print(f"{runs} runs of {1000 * runs_s / runs:.1f} ms CPU, {workers} workers, load {os.getloadavg()[0]:.0f}")
    print(f"CPU time: {whole_s:.1f} s, of the runs {runs_s:.1f} s: {(whole_s - runs_s) / runs_s:.1%} more")
    each_ms = 1000 * (whole_s - runs_s - once_s + few_s) / (runs - workers)
    print(f"paid once: {once_s - few_s:.1f} s; for each run: {each_ms:.2f} ms; wall {wall_s:.0f} s")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
