"""Triggers and clocks as a rig's author writes them, and a run that has both."""

import numpy as np
import pytest

from emulator.cli.app import _main
from emulator.rig.loading import RigError, parse_rig
from emulator.rig.tables import Trigger
from emulator.run.assembly import TriggerPaths
from firmware_protocol.device.clock import ClockSettings, ClockStep
from firmware_protocol.events import EdgeKind
from tests.npz_records import load_edges
from transports.link.edges import EdgeRing, PeriodicEdges
from transports.link.rings import EventRing
from transports.recording.record import load_record

SCENE = '[scene]\nkind = "checkerboard"\nspeed_px_s = 20.0\n'
SMALL = "[camera.sensor]\nwidth = 64\nheight = 48\n"
LINK = '[[links]]\nkind = "loopback"\n'


def rig(text):
    return parse_rig(SCENE + text + LINK, "my.toml", "my")


def test_a_trigger_and_a_clock_are_typed():
    loaded = rig(
        '[trigger]\nperiod_ms = 5\nkind = "rising"\n[camera.clock]\ndrift_ppm = -20\nrestarts_s = [3]\n'
        "[[camera.clock.steps]]\nat_s = 1\nby_us = -5\n"
    )
    assert loaded.trigger == Trigger(period_ms=5, kind="rising")
    assert loaded.camera.clock == ClockSettings(drift_ppm=-20, restarts_s=(3,), steps=(ClockStep(1, -5),))


def test_without_the_tables_there_is_neither():
    loaded = rig("")
    assert loaded.trigger is None
    assert loaded.camera.clock is None


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[trigger]\n", "a trigger needs source"),
        ("[trigger]\nperiod_ms = 0.001\n", "period_ms must be"),
        ('[trigger]\nperiod_ms = 1\nkind = "level"\n', "trigger.kind"),
        ("[trigger]\nperiod_ms = 1\nlatency_us = -1\n", "latency_us must be"),
        ("[trigger]\nperiod_ms = 1\npulse_us = 0\n", "pulse_us must be"),
        ("[trigger]\nperiod_ms = 1\nchannel = 256\n", "channel must be"),
        ("[trigger]\nperiod_ms = 1\nedges = [{at_ms = 1}]\n", "edges come at given times"),
        ("[[trigger.edges]]\nat_ms = -1\n", "at_ms must be"),
        ("[[trigger.edges]]\nat_ms = 1\nevery_ms = 0.001\n", "every_ms must be"),
        ("[[trigger.edges]]\nat_ms = 1\ncount = 2\n", "count must be"),
        ('[[trigger.edges]]\nat_ms = 1\nkind = "level"\n', "kind"),
        ('[trigger]\nperiod_ms = 1\nsource = "x"\n', "period_ms makes edges without a bus"),
        ('[trigger]\nsource = "loopback"\n', "'loopback' is not a link with a bus"),
        ("[camera.clock]\nwalk_ppb = -1\n", "camera.clock.walk_ppb"),
        ("[[camera.clock.steps]]\nat_s = -1\nby_us = 0\n", "at_s must be"),
        ('[run]\npace = "lockstep"\n', "lockstep_us and pace"),
        ("[run]\nlockstep_us = 10\n", "lockstep_us and pace"),
        ('[run]\npace = "lockstep"\nlockstep_us = 10\n', "lockstep needs a bus"),
    ],
)
def test_mistakes_are_told(text, told):
    with pytest.raises(RigError, match=r"my\.toml, line") as error:
        rig(text)
    assert told in str(error.value)


def test_edges_at_given_times_are_those_of_the_table():
    loaded = rig(
        '[[trigger.edges]]\nat_ms = 2.5\nkind = "rising"\n[[trigger.edges]]\nat_ms = 1\nevery_ms = 2\ncount = 3\n'
        "[[trigger.edges]]\nat_ms = 4\nevery_ms = 10\n"
    )
    source = TriggerPaths(loaded.trigger, ["a"], 1).timing("a", None, None).edges
    told = [(int(e["t"]), EdgeKind(e["kind"]).name) for e in source.take(15_000)]
    pulses = [(1000, "PULSE"), (2500, "RISING"), (3000, "PULSE"), (4000, "PULSE"), (5000, "PULSE"), (14_000, "PULSE")]
    assert told == pulses


def test_a_period_needs_no_ring_and_no_holding_back():
    timing = TriggerPaths(Trigger(period_ms=5), ["a"], 1).timing("a", None, None)
    assert isinstance(timing.edges, PeriodicEdges)
    assert timing.holdback_us == 0


def test_a_bus_has_a_ring_for_each_link_and_one_sink():
    paths = TriggerPaths(Trigger(source="bus", holdback_us=1500), ["bus", "usb"], 1)
    timings = [paths.timing(name, None, None) for name in ("bus", "usb")]
    assert all(isinstance(timing.edges, EdgeRing) and timing.holdback_us == 1500 for timing in timings)
    run = EventRing(16)
    run.start(1000)
    assert paths.sink("usb", run) is None
    paths.sink("bus", run)(5_001_000, 9)
    for timing in timings:
        assert timing.edges.take(5000).tolist() == [(5000, EdgeKind.PULSE, 0, 9)]


def test_no_trigger_no_edges():
    paths = TriggerPaths(None, ["a"], 1)
    assert paths.timing("a", None, None).edges is None
    assert paths.sink("a", EventRing(16)) is None


@pytest.mark.parametrize("pace", ["free", "realtime"])
def test_a_run_delivers_its_edges_in_the_cameras_own_time(tmp_path, json_of, pace):
    path, record, truth = (tmp_path / name for name in ("t.toml", "r.npz", "t.csv"))
    path.write_text(
        f'{SCENE}{SMALL}[camera.clock]\ndrift_ppm = 1000\n[trigger]\nperiod_ms = 10\nkind = "rising"\n'
        f'[run]\nstep_us = 2000\nseconds = 0.2\nmax_late_ms = 0\npace = "{pace}"\n{LINK}'
    )
    link = json_of(0, "run", path, "--record", record, "--truth", truth)["links"]["loopback"]
    # The host starts the camera before stream time does, and its clock is zero then.
    edges, resets = load_edges(record)
    rising = edges[edges["kind"] == EdgeKind.RISING]
    assert resets == [0]
    assert rising["t"].tolist() == [k * 10_010 for k in range(1, len(rising) + 1)]
    assert len(rising) == link["edges"]["taken"] == 20
    assert link["edges"]["balanced"]
    assert link["edges"]["late"] == 0
    events, _ = load_record(record)
    assert int(events["t"].max()) > 199_000
    rows = np.loadtxt(truth, delimiter=",", skiprows=1, ndmin=2)
    assert np.allclose(rows[:, 2], rows[:, 1] * 1.001, atol=1)


def test_truth_without_a_clock_is_wrong_use(tmp_path, capsys):
    path = tmp_path / "t.toml"
    path.write_text(SCENE + SMALL + LINK)
    assert _main(["run", str(path), "--truth", str(tmp_path / "t.csv")]) == 2
    assert "[camera.clock]" in capsys.readouterr().err
