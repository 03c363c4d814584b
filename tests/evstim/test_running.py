"""A run that is read while it goes on: every event once, and an end that is clean however it comes."""

import dataclasses
import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

import evstim
from evstim import running


def unhurried():
    """The rig `loopback`, of which a run in real time is good however late it is."""
    rig = evstim.load_rig("loopback")
    return dataclasses.replace(rig, run=dataclasses.replace(rig.run, max_late_ms=0.0))


def test_every_event_once_and_a_good_result(tmp_path):
    with evstim.run("loopback", seconds=0.05, pace="free", record=tmp_path / "sent.npz") as run:
        events = np.concatenate(list(run))
    assert run.result.good
    assert len(events) == run.result.ledger.read_out > 1000
    assert events.dtype == evstim.EVENT
    assert (np.diff(events["t"].astype(np.int64)) >= 0).all()
    sent, _ = evstim.load_record(tmp_path / "sent.npz")
    assert np.array_equal(sent, events)
    assert run.unread == 0


def test_break_stops_the_run():
    with evstim.run("loopback", seconds=1000.0, pace="free") as run:
        for events in run:
            assert len(events)
            break
    assert run.result.good
    assert run.result.sim_seconds < 100


def test_an_error_in_the_body_stops_the_run_and_stays_itself():
    live = evstim.run("loopback", seconds=1000.0, pace="free")
    with pytest.raises(ZeroDivisionError), live as run:
        assert next(iter(run)).size / 0
    assert live.result.good


def test_a_body_that_reads_nothing():
    with evstim.run(unhurried(), seconds=0.0, pace="realtime") as run:
        pass
    assert run.result.good


def test_a_reader_that_is_slow_holds_a_free_run_back_and_loses_nothing(monkeypatch):
    monkeypatch.setattr(running, "_MOST_QUEUED_BYTES", 6500)
    with evstim.run("loopback", seconds=0.02, pace="free") as run:
        first = next(iter(run))
        rest = list(run)
    assert len(first) + sum(map(len, rest)) == run.result.ledger.read_out
    assert run.unread == 0


def test_a_reader_that_is_slow_does_not_hold_back_real_time(monkeypatch):
    monkeypatch.setattr(running, "_MOST_QUEUED_BYTES", 6500)
    with evstim.run(unhurried(), seconds=0.1, pace="realtime") as run:
        run._thread.join()
        read = sum(map(len, run))
    assert run.unread > 0
    assert read + run.unread == run.result.ledger.read_out
    assert run.result.good


def test_a_rig_made_in_python():
    scene = evstim.CheckerboardScene(square_px=8.0, speed_px_s=200.0)
    sensor = evstim.Sensor("davis346", width=32, height=24).parameters
    rig = evstim.Rig("mine", "my rig", scene, evstim.Camera(sensor=sensor))
    with evstim.run(rig, seconds=0.05, pace="free") as run:
        events = np.concatenate(list(run))
    assert events["x"].max() < 32
    assert run.rig.run.pace == "free"


def test_what_cannot_run():
    with pytest.raises(evstim.RigError, match="did you mean 'loopback'"):
        evstim.run("lopback")
    with pytest.raises(ValueError, match="seconds must be"):
        evstim.run("loopback", seconds=-1)
    rig = evstim.Rig("none", "no link", evstim.CheckerboardScene())
    with pytest.raises(ValueError, match="no link"):
        evstim.run(rig, record="x.npz")
    live = evstim.run("loopback", seconds=0.01)
    with pytest.raises(RuntimeError, match="use `with"):
        next(iter(live))
    with live, pytest.raises(RuntimeError, match="no result before"):
        _ = live.result
    with pytest.raises(RuntimeError, match="started before"), live:
        pass


def test_a_fault_is_an_object_or_a_table():
    scene, links = evstim.CheckerboardScene(), (evstim.SerialLink(name="a"), evstim.SerialLink(name="b"))
    live = evstim.run(evstim.Rig("serial", "one line", scene, links=links[:1]))
    live.inject(evstim.BitFlips(rate=1e-3, count=5))
    live.inject({"kind": "bit_flips", "rate": 1e-3, "count": 5})
    assert list(live._faults) == [evstim.BitFlips("a", rate=1e-3, count=5)] * 2
    with pytest.raises(Exception, match="no link of this rig can have a fault of kind 'bus_off'"):
        live.inject(evstim.BusOff())
    with pytest.raises(Exception, match="'link' is missing: a, b can all have 'bit_flips'"):
        evstim.run(evstim.Rig("serial", "two lines", scene, links=links)).inject(evstim.BitFlips())


def test_what_fails_in_the_run_is_raised_in_the_reader(tmp_path):
    video = evstim.VideoScene(path=str(tmp_path / "none.mp4"))
    rig = evstim.Rig("broken", "no video", video)
    with pytest.raises(evstim.SceneError, match="no such file"), evstim.run(rig, seconds=1) as run:
        list(run)
    with pytest.raises(evstim.SceneError, match="no such file"), evstim.run(rig, seconds=1):
        pass
    with pytest.raises(ZeroDivisionError) as caught, evstim.run(rig, seconds=1):
        1 / 0  # noqa: B018
    assert "no such file" in caught.value.__notes__[0]
    assert not [t for t in threading.enumerate() if t.name.startswith("evstim")]


SCRIPT = """
import dataclasses
import signal
import evstim
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored by what a shell starts in the background
rig = evstim.load_rig("loopback")
rig = dataclasses.replace(rig, run=dataclasses.replace(rig.run, max_late_ms=0.0))
with evstim.run(rig, seconds=0.0, pace="realtime") as run:
    try:
        for events in run:
            print("reading", flush=True)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
print(run.result.good, flush=True)
"""


@pytest.mark.system
def test_ctrl_c_in_a_script_without_a_main_guard(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    process = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True, env=os.environ)
    assert process.stdout.readline() == "reading\n"
    process.send_signal(signal.SIGINT)
    lines = process.communicate(timeout=300)[0].splitlines()
    assert [line for line in lines if line != "reading"] == ["interrupted", "True"]
    assert process.returncode == 0
