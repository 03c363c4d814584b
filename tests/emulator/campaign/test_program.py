"""The program under test: its arguments, its end, its result."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from emulator.campaign.campaign import addresses_as_placeholders, filled
from emulator.campaign.loading import Program
from emulator.campaign.one_run import RunningProgram, end_leftover, result_of
from tests.emulator.campaign.processes import gone


def test_placeholders_are_filled():
    values = {"index": 3, "camera.sensor.threshold_on": 0.25, "faults[0].rate": 1e-6, "list": [1]}
    argv = ["a{index}", "{camera.sensor.threshold_on}", "{faults[0].rate}", "{list}", '{"json": 1}', "{}"]
    assert filled(argv, values) == ["a3", "0.25", "1e-06", "[1]", '{"json": 1}', "{}"]


def test_addresses():
    assert addresses_as_placeholders({"usb": "127.0.0.1:3240"}) == {
        "address.usb": "127.0.0.1:3240",
        "port.usb": "3240",
        "address": "127.0.0.1:3240",
        "port": "3240",
    }
    assert "address" not in addresses_as_placeholders({"a": "x:1", "b": None})


def test_a_program_runs_and_gives_its_exit_code(tmp_path):
    argv = ("{python}", "-c", "import os; print(os.getcwd(), os.environ['EVSTIM_RUN']); raise SystemExit(3)")
    with RunningProgram(Program(argv), tmp_path, Path("/"), "id/7", {}) as program:
        code, seconds = program.wait(120)
    assert code == 3
    assert seconds > 0
    assert (tmp_path / "output.txt").read_text() == "/ id/7\n"


def test_a_program_that_goes_on_is_stopped_with_its_children(tmp_path):
    script = "import subprocess, sys, time; p = subprocess.Popen(['sleep', '600']); print(p.pid, flush=True); p.wait()"
    with RunningProgram(Program((sys.executable, "-c", script)), tmp_path, tmp_path, "id/1", {}) as program:
        until_s = time.monotonic() + 120
        while not (tmp_path / "output.txt").read_text().endswith("\n"):
            assert time.monotonic() < until_s
            time.sleep(0.02)
        assert program.wait(0.01)[0] is None
        child = int((tmp_path / "output.txt").read_text())
    assert gone(child)
    assert not (tmp_path / "program.pid").exists()


def test_a_program_left_by_a_killed_worker_is_ended_and_no_other(tmp_path):
    # A program that runs: right after it was started, the kernel shows an empty environment of it.
    argv = [sys.executable, "-c", "import time; print(flush=True); time.sleep(600)"]
    with subprocess.Popen(argv, env={"EVSTIM_RUN": "id/1"}, start_new_session=True, stdout=subprocess.PIPE) as left:
        assert left.stdout is not None
        assert left.stdout.readline() == b"\n"
        (tmp_path / "program.pid").write_text(str(left.pid))
        end_leftover(tmp_path, "id/2")
        assert left.poll() is None
        end_leftover(tmp_path, "id/1")
        assert left.wait(120) == -signal.SIGKILL
    (tmp_path / "program.pid").write_text(str(os.getpid()))
    end_leftover(tmp_path, "id/1")


@pytest.mark.parametrize(
    ("text", "columns", "trouble"),
    [
        (json.dumps({"a": 1, "b": "x", "c": True, "d": None}), {"a": 1.0, "b": "x", "c": True, "d": None}, ""),
        ('{"a": NaN}', None, ""),
        ("{", {}, "no JSON"),
        ("[1]", {}, "expected one JSON object"),
        ('{"a": [1], "b": 2}', {"b": 2.0}, "result: a: neither"),
        (json.dumps({str(k): k for k in range(201)}), {}, "at most 200"),
        ("[" * 100_000, {}, "no JSON"),
    ],
)
def test_results(tmp_path, text, columns, trouble):
    file = tmp_path / "result.json"
    file.write_text(text)
    found, told = result_of(file)
    if columns is not None:
        assert found == {f"result.{name}": value for name, value in columns.items()}
        assert all(type(value) is not int for value in found.values())
    assert trouble in told
    assert bool(trouble) == bool(told)


def test_no_result_is_no_trouble(tmp_path):
    assert result_of(tmp_path / "result.json") == ({}, "")
