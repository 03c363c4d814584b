"""Updates a second that `evstim vizard` keeps up with, with Basilisk and the shipped example.

    python -m laboratory.benchmarks.basilisk_rate PYTHON_WITH_BSK [RIG] [SECONDS] [STEP_US]

An update is one SIM_UPDATE and the image requested after it, 346 x 260. CPU time is counted from the first update on:
on a machine that does nothing else the two programs take turns, so 1 / (evstim + Basilisk) is the rate to expect there.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

EXAMPLE = Path(__file__).parents[2] / "examples" / "basilisk"
PERIOD_S = 0.04
START = "from emulator.cli import main; main()"


def cpu_s(pid: int) -> float:
    """Return the CPU time of a process and its dead children so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def spent_s(process: subprocess.Popen[str], before_s: float) -> float:
    """Wait for the end of a process; return the CPU time that it has taken since it had `before_s`."""
    used = os.wait4(process.pid, 0)[2]
    process.returncode = 0
    return used.ru_utime + used.ru_stime - before_s


def measure(python: str, rig: Path, seconds: float) -> dict[str, object]:
    """Return what one flight took."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    run = [sys.executable, "-c", START, "vizard", str(rig), "--at", "127.0.0.1:0", "--json"]
    with tempfile.TemporaryDirectory() as folder, subprocess.Popen(run, **pipes) as camera:  # type: ignore[call-overload]
        port = camera.stderr.readline().strip().rpartition(":")[2]
        program = [python, str(EXAMPLE / "simulation.py"), "--port", port, "--seconds", str(seconds)]
        with subprocess.Popen(program, cwd=folder, stdout=subprocess.DEVNULL) as dynamics:
            while "Basilisk is here" not in camera.stderr.readline():
                pass
            begun_s, before_s = time.monotonic(), (cpu_s(camera.pid), cpu_s(dynamics.pid))
            told = json.loads(camera.stdout.read().splitlines()[-1])
            wall_s = time.monotonic() - begun_s
            used_s = spent_s(camera, before_s[0]), spent_s(dynamics, before_s[1])
        known = json.loads(Path(folder, "simulation.json").read_text())
    counts = told["basilisk"]
    each_ms = [1000 * one / counts["updates"] for one in used_s]
    return {
        "updates": counts["updates"],
        "updates/s, wall": counts["updates"] / wall_s,
        "CPU ms an update, evstim / Basilisk": each_ms,
        "updates/s of their CPU time": 1000 / sum(each_ms),
        "clocks apart, ns": counts["last_ns"] - known["nanoseconds"],
        "load": os.getloadavg()[0],
        "told": counts,
    }


def main(python: str, rig: str = str(EXAMPLE / "eros.toml"), seconds: str = "40", step_us: str = "") -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "rig.toml")
        text = Path(rig).read_text()
        copy.write_text(re.sub(r"(?m)^step_us = \d+", f"step_us = {step_us}", text) if step_us else text)
        for name, value in measure(python, copy, float(seconds)).items():
            print(f"{name}: {value}")


if __name__ == "__main__":
    main(*sys.argv[1:])
