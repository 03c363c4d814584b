"""Latency from an event to its bytes in real time, run by run.

    python -m laboratory.bench.latency [RUNS [SECONDS [BUSY]]]

The checkerboard at 346x260, some 1.5 Mev/s and steps of 1 ms, with a USB/IP link and a receiver that decodes every
word: the run of `evstim bench --only 'latency_*'`, each time in new processes. BUSY programs that never sleep run
beside it, in a session of their own, as those of another user.

For each run a row: median, 99th and 99.9th percentile and maximum of the latency, us; late and longer steps; how late
the worst step was, and the lead that the steps needed (p50, p99, p99.9), us. Exit code 1 where a run misses a limit:
p50 1 ms, p99 3 ms, p99.9 10 ms and no late step, or beside busy programs a p99 of 10 ms. A run that drops events, or is
so short that its receiver comes too late for 0.5 Mev/s, fails: give at least five seconds.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from laboratory.bench.links import paced_run
from laboratory.bench.streams import say

_ONE = "--one"
_NAMES = (
    "p50", "p99", "p999", "max", "late steps", "longer steps", "worst lateness", "lead p50", "lead p99", "lead p999",
)  # fmt: skip
_LIMITS = {"p50": 1000.0, "p99": 3000.0, "p999": 10_000.0, "late steps": 0.0}
_LIMITS_BESIDE_OTHERS = {"p99": 10_000.0}
_SPIN = "while True: pass"


def one(seconds: float) -> dict[str, float]:
    """Return the values of one run in this process."""
    result = paced_run(seconds)
    (report,) = result.links.values()
    lateness, lead, latency = result.lateness, result.lateness.lead_needed_us, report.latency
    values = (
        *(latency.p50, latency.p99, latency.p999, latency.max),
        *(lateness.frames_late, lateness.steps_stretched, lateness.worst_gap_us),
        *(lead.p50, lead.p99, lead.p999),
    )
    return {name: float(value or 0.0) for name, value in zip(_NAMES, values, strict=True)}


@contextmanager
def busy_programs(count: int) -> Iterator[None]:
    """Run programs that never sleep."""
    programs = [subprocess.Popen([sys.executable, "-c", _SPIN], start_new_session=True) for _ in range(count)]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


def main(runs: int = 10, seconds: float = 10.0, busy: int = 0) -> int:
    """Measure and print a table; return the exit code."""
    limits, good = _LIMITS_BESIDE_OTHERS if busy else _LIMITS, 0
    say(f"| run | {' | '.join(_NAMES)} |\n|{'---|' * (len(_NAMES) + 1)}")
    for run in range(1, runs + 1):
        with busy_programs(busy):
            command = [sys.executable, __file__, _ONE, str(seconds)]
            process = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        if process.returncode:
            say(f"| {run} | failed, the reason is above |")
            continue
        values: dict[str, float] = json.loads(process.stdout.splitlines()[-1])
        met = all(values[name] <= limit for name, limit in limits.items())
        good += met
        say(f"| {run} | {' | '.join(f'{values[name]:.0f}' for name in _NAMES)} |{' missed' * (not met)}")
    say(f"{good} of {runs} runs meet {limits}, {busy} busy programs beside them, load {os.getloadavg()[0]:.1f}")
    return int(good < runs)


if __name__ == "__main__":
    if sys.argv[1:2] == [_ONE]:
        say(json.dumps(one(float(sys.argv[2]))))
        sys.exit(0)
    sys.exit(main(*map(int, sys.argv[1:2]), *map(float, sys.argv[2:3]), *map(int, sys.argv[3:4])))
