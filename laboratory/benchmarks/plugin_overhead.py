"""Time that the fixture `evstim_rig` adds to a test: empty tests with and without it, in one session of pytest.

    python -m laboratory.benchmarks.plugin_overhead [TESTS]

The rig is `loopback`, and a test with it is given its address. Printed are the durations of setup, call and teardown as
pytest reports them, medians without the first test, which loads and compiles; and the processor time that a test more
costs, of all processes, from sessions of TESTS and of 3 TESTS: on a busy machine that one counts. Exit code 1 where
setup and teardown take more than 0.5 s together.
"""

from __future__ import annotations

import os
import re
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from laboratory.benchmarks.streams import children_s

MOST_S = 0.5
TEST = """
import pytest

@pytest.mark.parametrize("number", range({count}))
@pytest.mark.rig("loopback", seed=7)
def test_with_the_rig(evstim_rig, number):
    assert evstim_rig.addresses == {{"loopback": None}}

@pytest.mark.parametrize("number", range({count}))
def test_without(number):
    pass
"""


def measured(count: int, folder: Path) -> dict[str, float]:
    """Return the median of each phase of the tests with the rig, seconds, without the first one."""
    (folder / "test_overhead.py").write_text(TEST.format(count=count), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--durations=0", "--durations-min=0"]
    plugin = ["-p", "evstim.testing.plugin"] if os.environ.get("PYTEST_DISABLE_PLUGIN_AUTOLOAD") else []
    command += [*plugin, "test_overhead.py"]
    done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stdout)
    found = re.findall(r"([\d.]+)s (setup|call|teardown) +\S*test_with_the_rig\[(\d+)\]", done.stdout)
    phases: dict[str, list[float]] = {"setup": [], "call": [], "teardown": []}
    for seconds, phase, number in found:
        if number != "0":
            phases[phase].append(float(seconds))
    return {phase: statistics.median(seconds) for phase, seconds in phases.items()}


def main(count: int = 6) -> int:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as folder:
        measured(2, Path(folder))  # compiles
        marks = [children_s()]
        for tests in (count, 3 * count):
            phases = measured(tests, Path(folder))
            marks.append(children_s())
    added_s = phases["setup"] + phases["teardown"]
    each_s = (marks[2] - marks[1] - (marks[1] - marks[0])) / (2 * count)
    durations = ", ".join(f"{phase} {seconds:.2f} s" for phase, seconds in phases.items())
    sys.stdout.write(
        f"{durations}; the fixture adds {added_s:.2f} s to a test, load {os.getloadavg()[0]:.1f}; "
        f"processor time of all processes {each_s:.2f} s a test\n"
    )
    return int(added_s > MOST_S)


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
