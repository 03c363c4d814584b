"""A whole run as a program of its own, with its receiver; and what processes use."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from emulator.cli.app import _main
from laboratory.bench.streams import BenchFailed
from laboratory.realtime.program import Received, Span, _speed, children, measure_speed, use_of
from laboratory.realtime.variants import SIZES, variant_of

BOARD = '[scene]\nkind = "checkerboard"\nspeed_px_s = 30.0\n[run]\nstep_us = 5000\n'


class Meter:
    session_cores, link_cores, receiver_cores, memory_mib = 0.9, 0.1, None, 300.0


def run_json(delivered):
    links = {"usbip": {"delivered": delivered, "dropped": 0, "dropped_in_device": 25}}
    return {"sim_seconds": 3.0, "wall_seconds": 1.5, "events": {"read_out": delivered + 25, "links": links}}


def test_a_speed_is_that_of_the_run_and_of_what_was_received():
    speed = _speed(run_json(75), Meter, Received(70, 0, 12.5), 10.0)
    assert (speed.factor, speed.stream_s, speed.events) == (2.0, 3.0, 70)
    assert speed.received_share == 0.7
    assert speed.first_event_s == 2.5
    assert (speed.session_cores, speed.receiver_cores, speed.memory_mib) == (0.9, None, 300.0)


@pytest.mark.parametrize("received", [Received(75, 1, 1.0), Received(76, 0, 1.0)])
def test_a_receiver_that_differs_is_a_failure(received):
    with pytest.raises(BenchFailed, match="75 events delivered"):
        _speed(run_json(75), Meter, received, 0.0)


@pytest.mark.system
@pytest.mark.socket
def test_a_run_that_cannot_begin_is_a_failure_with_its_reason(tmp_path):
    rig = tmp_path / "board.toml"
    rig.write_text(BOARD)
    variant = variant_of(str(rig), SIZES[0])
    variant.tables["scene"]["square_px"] = -1.0
    with pytest.raises(BenchFailed, match="square_px"):
        measure_speed(variant, Span(stream_s=0.1, wall_s=1.0))


@pytest.mark.system
@pytest.mark.socket
def test_the_command_measures_a_rig_from_end_to_end(tmp_path, capsys):
    rig = tmp_path / "board.toml"
    rig.write_text(BOARD)
    command = ["bench", "realtime", str(rig), "--quick", "--size", "346x260", "--out", str(tmp_path / "out"), "--json"]
    assert _main(command) == 0
    (row,) = json.loads(capsys.readouterr().out.strip().splitlines()[-1])["rows"]
    assert row["factor"] > 0
    assert 0 <= row["wrong"] < 0.1


@pytest.mark.system
@pytest.mark.socket
def test_ctrl_c_at_a_terminal_ends_all_processes_and_leaves_a_report(tmp_path):
    """The signal goes to the whole group, at a moment when a run goes on."""
    rig, out = tmp_path / "board.toml", tmp_path / "out"
    rig.write_text(BOARD.replace("5000", "20"))
    start = "import json, sys; sys.path[:] = json.loads(sys.argv.pop(1)); from emulator.cli import main; main()"
    options = ["bench", "realtime", str(rig), "--size", "346x260", "--out", str(out), "--json"]
    command = [sys.executable, "-P", "-c", start, json.dumps(sys.path), *options]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    bench = subprocess.Popen(command, text=True, start_new_session=True, **pipes)
    while len(below := list(children(bench.pid))) < 3:  # receiver, session, link
        assert bench.poll() is None
        time.sleep(0.02)
    os.killpg(bench.pid, signal.SIGINT)
    printed, errors = bench.communicate(timeout=120)
    assert bench.returncode == 1
    assert "interrupted" in json.loads(printed.splitlines()[-1])["note"]
    assert "Traceback" not in errors
    assert [pid for pid in below if use_of(pid)] == []
