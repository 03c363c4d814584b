#!/usr/bin/env python3
"""Ledger of the time of `make test`: its parts beside their budget, and the twenty dearest files.

    times.py                        print the ledger; exit with 1 where a part took 1.5 times its budget
    times.py PART COMMAND [ARG...]  run a command as a part, and add its processor and wall time to the ledger

Budgets are the processor seconds in `[seconds]` of house.toml, on a machine whose `calibration` takes the seconds given
there; they may only fall. Machines differ, so a budget is scaled by the same calibration here: a loop of Python, which
is most of what tests run, the fastest of several. Wall time is printed and not judged.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / ".cache" / "test-times"
CALIBRATION = "calibration"
SLACK = 1.5  # a busy machine needs more processor time: its caches and, of two hyperthreads, half a core are taken
DEAREST = 20

Seconds = dict[str, float]
Ledger = dict[str, dict[str, Seconds]]
"""By part and file: seconds "processor", "wall" and "compiled", the latter within the processor's."""


def calibration_s() -> float:
    """Return the processor seconds of a fixed loop, the least of seven."""
    least_s = float("inf")
    for _ in range(7):
        began_s, total = time.process_time(), 0
        for number in range(2_000_000):
            total += number * number & 7
        least_s = min(least_s, time.process_time() - began_s)
    return least_s


def run(part: str, command: list[str]) -> int:
    """Run a command, write its ledger, and return its exit code."""
    began_s = time.monotonic()
    code = subprocess.run(command, check=False).returncode
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = {"processor": used.ru_utime + used.ru_stime, "wall": time.monotonic() - began_s, "compiled": 0.0}
    file, name = FOLDER / f"{part}.json", " ".join(command)
    before = json.loads(file.read_text()).get(name, {}) if file.exists() else {}
    FOLDER.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps({name: {key: value + before.get(key, 0.0) for key, value in seconds.items()}}))
    return code


def sums(files: dict[str, Seconds]) -> Seconds:
    """Return the seconds of all files together."""
    names = ("processor", "wall", "compiled")
    return {name: sum(seconds.get(name, 0.0) for seconds in files.values()) for name in names}


def lines_of(ledger: Ledger, budget: Seconds, scale: float) -> list[str]:
    """Return the table for people."""
    lines = [f"seconds of processor (compiled: within them); this machine takes {scale:.2f} times the reference's"]
    for part, files in ledger.items():
        total = sums(files)
        allowed = f"{budget[part] * scale:7.0f}" if part in budget else "      -"
        lines.append(f"{total['processor']:7.0f} of {allowed}  compiled {total['compiled']:5.0f}  {part}")
    everything = sum(sums(files)["processor"] for files in ledger.values())
    rows = [(seconds["processor"], part, file) for part, files in ledger.items() for file, seconds in files.items()]
    lines += [f"{everything:7.0f} together", f"the {DEAREST} dearest files:"]
    rows.sort(reverse=True)
    return lines + [f"{processor:7.1f}  {part}: {file}" for processor, part, file in rows[:DEAREST]]


def broken(ledger: Ledger, budget: Seconds, scale: float) -> list[str]:
    """Return a sentence for each part that took more than its budget allows."""
    sentences = []
    for part, files in ledger.items():
        processor, most = sums(files)["processor"], SLACK * scale * budget.get(part, float("inf"))
        if processor > most:
            sentences.append(
                f"{part} took {processor:.0f} s of processor, more than {most:.0f} s: [seconds] in house.toml"
            )
    return sentences


def main(arguments: list[str]) -> int:
    """Do what the arguments request; return the exit code."""
    if arguments:
        return run(arguments[0], arguments[1:])
    ledger = {file.stem: json.loads(file.read_text()) for file in sorted(FOLDER.glob("*.json"))}
    budget = tomllib.loads((ROOT / "house.toml").read_text())["seconds"]
    scale = calibration_s() / budget.pop(CALIBRATION)
    sentences = broken(ledger, budget, scale)
    print("\n".join([*lines_of(ledger, budget, scale), *sentences]))
    return 1 if sentences else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
