"""Pieces of a run at each rung: where a step costs most, what is measured, and the wrong events of the light."""

import dataclasses
from contextlib import nullcontext

import numpy as np
import pytest

from emulator.light import SceneEnded, SceneError
from emulator.rig.loading import load_rig, parse_rig
from emulator.run import tuning
from emulator.run.assembly import link_setups
from emulator.run.link_process import LinkFailed
from emulator.run.session import Session
from emulator.run.tuning import Ladder
from emulator.scene.checkerboard.checkerboard import Checkerboard
from transports.link.report import LinkReport

RIG = """
[scene]
kind = "bodies"
[scene.sun]
direction = [-0.6, -0.3, -0.75]
[scene.camera]
kind = "fixed"
position_m = [0.0, 0.0, -100000.0]
[[scene.bodies]]
shape = "eros022540"
units_m = 1000.0
[scene.bodies.path]
kind = "spin"
pole = [0.0, -1.0, 0.0]
spin_deg_s = 6.0
[camera]
model = "davis346"
sensor = {width = 64, height = 48}
lens = {field_of_view_deg = 21.0, f_number = 5.0}
[run]
step_us = 40000
seconds = 20.0
QUALITY
[[links]]
kind = "udp_packets"
command_port = 1
"""


def rig_at(quality=-1):
    return parse_rig(RIG.replace("QUALITY", f"quality = {quality}"), "rock.toml", "rock")


@pytest.fixture
def short(monkeypatch):
    for name, value in (("_SWEEP", 4), ("_PIECE_S", 0.05), ("_DEAREST", 2)):
        monkeypatch.setattr(tuning, name, value)


def test_the_dearest_instants_are_on_drawings_of_every_rung(monkeypatch, short):
    def costs(frames, source, t_ns, step_ns, wall_s):
        return [np.array([float(t_ns == 9_600_000_000), 1e-3])]

    monkeypatch.setattr(tuning, "step_costs", costs)
    with Ladder(rig_at()) as ladder:
        assert len(ladder.starts_ns) == 2
        assert ladder.starts_ns[0] == 9_600_000_000
        assert not any(t_ns % (24 * 40_000_000) for t_ns in ladder.starts_ns)


def test_a_rung_is_measured_in_a_session_without_the_rigs_own_links(monkeypatch, short):
    opened = []
    monkeypatch.setattr(tuning, "link_setups", lambda rig: opened.append(rig.links) or link_setups(rig))
    with Ladder(rig_at()) as ladder:
        exact, fast = (ladder.climb(rig_at(quality)) for quality in (0, 5))
    assert [[link.kind for link in links] for links in opened] == [["loopback"]] * 2
    assert [link.name for link in opened[0]] == ["udp_packets"]
    assert exact.wrong_share == 0 < fast.wrong_share < 1
    for rung in (exact, fast):
        assert 0 < rung.slowest <= rung.median
        assert rung.p99_ms > 0
        assert rung.memory_mib > 10


def test_pieces_end_with_the_run(short):
    rig = load_rig("checkerboard")
    sensor = dataclasses.replace(rig.camera.sensor, width=32, height=24)
    camera, run = dataclasses.replace(rig.camera, sensor=sensor), dataclasses.replace(rig.run, seconds=0.02)
    rig = dataclasses.replace(rig, run=run, camera=camera, links=())
    with Ladder(rig) as ladder:
        assert ladder.starts_ns == [0]
        assert ladder.climb(rig).slowest > 0


def test_the_links_read_a_rig_with_an_inertial_unit_without_error(short):
    rig = load_rig("stars-dvxplorer-micro")
    assert rig.camera.imu is not None
    with Ladder(rig) as ladder:
        assert ladder.climb(rig).memory_mib > 10


def test_a_piece_that_fails_is_an_error(monkeypatch, short):
    run, rig = Session.run, dataclasses.replace(load_rig("stars"), links=())

    def failing(*arguments, **named):
        failed = LinkReport(state="failed", error="the host is gone")
        return dataclasses.replace(run(*arguments, **named), links={"usbip": failed})

    with Ladder(rig) as ladder:
        monkeypatch.setattr(Session, "run", failing)
        with pytest.raises(LinkFailed, match="the host is gone"):
            ladder.climb(rig)


@pytest.mark.parametrize("last_step", [0, 1, 2, 5, 20])
def test_a_scene_that_ends_early_is_measured_up_to_its_end(last_step, monkeypatch, short):
    rig = dataclasses.replace(load_rig("checkerboard"), links=())
    draw = Checkerboard.light_and_rate

    def ends(self, t_ns, *arrays):
        if t_ns > last_step * rig.run.step_us * 1000:
            raise SceneEnded("no more light")
        draw(self, t_ns, *arrays)

    monkeypatch.setattr(Checkerboard, "light_and_rate", ends)
    with nullcontext() if last_step > 2 else pytest.raises(SceneError), Ladder(rig) as ladder:
        assert ladder.climb(rig).slowest > 0
