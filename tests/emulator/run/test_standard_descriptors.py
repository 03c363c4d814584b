"""Whole programs that start with some of the descriptors 0 to 2 closed: every event has its fate and is recorded."""

import itertools
import json
import subprocess
import sys

import numpy as np
import pytest

RIG = """
[scene]
kind = "checkerboard"
speed_px_s = 20.0
[camera.sensor]
width = 64
height = 48
[run]
step_us = 2000
seconds = 0.2
pace = "free"
[[links]]
kind = "loopback"
"""
CLOSED = ("<&-", ">&-", "2>&-")
ONE_OR_ALL_CLOSED = [*CLOSED, " ".join(CLOSED)]
SOME_CLOSED = [" ".join(some) for count in (3, 2, 1) for some in itertools.combinations(CLOSED, count)]
COMMAND = """
from emulator.cli import main
main()
"""
PROGRAM = """
import json, os, sys
import evstim
with evstim.run(sys.argv[1], record=sys.argv[2]) as run:
    for number in (1, 2):  # as a library does that prints without Python
        os.write(number, 100 * b"a library prints this")
    result = run.wait()
with open(sys.argv[3], "w") as file:
    json.dump({"balanced": result.ledger.balanced, "events": result.ledger.as_json()}, file)
"""
CHILD = """
import os, subprocess, sys
from emulator.run import fill_standard_descriptors
fill_standard_descriptors()
look = "import os, sys; [os.fstat(number) for number in (0, 1, 2)]"
sys.exit(subprocess.run([sys.executable, "-c", look], close_fds=True).returncode)
"""


@pytest.fixture
def rig(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(RIG)
    return path


def run_closed(closed, code, *arguments):
    """Run Python code by a shell that closes descriptors before; return the exit code."""
    command = ["sh", "-c", f'exec "$@" {closed}', "sh", sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, timeout=300, check=False).returncode


def check(told, record):
    delivered = told["events"]["links"]["loopback"]
    assert told["balanced"] is True
    assert delivered["dropped"] == delivered["dropped_in_device"] == 0
    assert delivered["delivered"] > 100
    with np.load(record) as file:
        assert len(file["events"]) == delivered["delivered"]


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("closed", ONE_OR_ALL_CLOSED)
def test_a_command_counts_and_records_every_event(closed, rig, tmp_path):
    record, report = tmp_path / "a.npz", tmp_path / "report"
    assert run_closed(closed, COMMAND, "run", rig, "--record", record, "--report", report) == 0
    check(json.loads((report / "report.json").read_text()), record)


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("closed", ONE_OR_ALL_CLOSED)
def test_a_program_counts_and_records_every_event(closed, rig, tmp_path):
    record, result = tmp_path / "a.npz", tmp_path / "result.json"
    assert run_closed(closed, PROGRAM, rig, record, result) == 0
    check(json.loads(result.read_text()), record)


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("closed", SOME_CLOSED)
def test_child_processes_have_the_descriptors_too(closed):
    assert run_closed(closed, CHILD) == 0
