"""Plans of probed scenes."""

import dataclasses

import numpy as np
import pytest

from emulator.plan.plan import line_loads, make_plan
from emulator.plan.scene_probe import probe
from emulator.rig.loading import load_rig
from emulator.scene.checkerboard.checkerboard import Checkerboard
from firmware_protocol.instrument.settings import InstrumentSettings
from tests.emulator.plan.test_decide import SCENE
from transports.network_streams.kind import TcpLink
from transports.serial_line.kind import SerialLink

RIG = load_rig("checkerboard")


def with_tolerance(tolerance_us, **scene):
    rig = dataclasses.replace(RIG, run=dataclasses.replace(RIG.run, tolerance_us=tolerance_us, method="hermite"))
    return make_plan(rig, dataclasses.replace(SCENE, **scene))


def test_a_rig_without_tolerance_pins_everything():
    plan = make_plan(RIG, SCENE)
    assert plan.pinned
    assert not plan.steps.controlled
    assert plan.steps.step_us == RIG.run.step_us
    assert plan.sensor == RIG.camera.sensor


def test_a_tolerance_sets_the_step_by_the_fourth_root():
    near, far = with_tolerance(0.2), with_tolerance(3.2)
    assert far.steps.step_us / near.steps.step_us == pytest.approx(2.0)
    assert far.steps.error_us == pytest.approx(3.2)
    assert far.steps.bound == "the tolerance"


def test_the_longest_step_and_the_wrong_events_bound_it():
    assert with_tolerance(1e6, hermite_error_us=1e-3).steps.step_us == 100_000
    assert "longest" in with_tolerance(1e6, hermite_error_us=1e-3).steps.bound
    assert with_tolerance(1e5, hermite_slips=0.08).steps.step_us == pytest.approx(1000 * 0.5)
    assert "wrong events" in with_tolerance(1e5, hermite_slips=0.08).steps.bound


def test_a_loose_tolerance_leaves_effects_out_of_the_sensor():
    plan = with_tolerance(1e6)
    assert plan.sensor.refractory_us == 0
    assert plan.sensor != plan.rig.camera.sensor


def test_a_probe_of_the_board_predicts_its_events():
    """Squares of 50 px, 100 px/s to the right: two edges of ln(bright/dark) a second in each pixel."""
    sensor = RIG.camera.sensor
    board = dataclasses.replace(RIG.scene, square_px=50.0, direction_deg=0.0, speed_px_s=100.0)
    with Checkerboard(board, (sensor.width, sensor.height)) as scene:
        seen = probe(scene, sensor, 10_000_000, 2.0)
    swing = np.log((board.bright + sensor.dark_current_relative) / (board.dark + sensor.dark_current_relative))
    threshold = (sensor.threshold_on + sensor.threshold_off) / 2
    expected = sensor.width * sensor.height * 100.0 / 50.0 * swing / threshold
    assert seen.events_per_s == pytest.approx(expected, rel=0.05)
    assert seen.motion_px_s == pytest.approx(100.0)
    assert 0.9 < seen.largest_current / board.bright < 1.1


def test_a_line_carries_a_share_of_the_expected_events():
    rig = dataclasses.replace(load_rig("serial-demo"), links=(SerialLink(baud=115_200), TcpLink()))
    (load,) = line_loads(rig, 66_000.0)
    assert 3000 < load.carries_hz < 5000
    assert load.share == pytest.approx(load.carries_hz / 66_000)
    assert load.line == (
        "link serial: its line carries about 3300 events/s, 4.9 % of the 66000 that the scene is expected to give"
    )
    width, height = rig.camera.size
    region = (0, 0, width // 10, height // 10)
    small = dataclasses.replace(rig, links=(SerialLink(baud=115_200, instrument=InstrumentSettings(region=region)),))
    assert line_loads(small, 66_000.0)[0].share == 1
    assert line_loads(rig, 0.0)[0].share == 1
    assert "evstim plan" in line_loads(rig)[0].line
