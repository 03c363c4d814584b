"""Two cameras of one rig on one clock: tables, and the parallax of what both see."""

import dataclasses
import math

import numpy as np
import pytest

from emulator.rig.kinds import CAMERA_MODELS
from emulator.rig.loading import RigError, load_rig, parse_rig, second_rig
from emulator.rig.tables import SecondCamera
from emulator.run.assembly import link_setups
from emulator.run.camera import CameraView, ReadingSources
from emulator.trajectory.building import MountedPath, build_trajectory
from emulator.trajectory.parameters import SpinPath
from emulator.trajectory.pose import differences
from firmware_protocol.events import EdgeKind
from tests.npz_records import load_edges
from transports.link.report import CameraSettings
from transports.recording.record import load_record

SCENE = """
[scene]
kind = "stars"
faintest_v = -2.0
[scene.camera]
kind = "fixed"
look_at_m = [0.0, 100.0, 0.0]
[scene.sun]
direction = [0.0, -1.0, 0.2]
[[scene.points]]
radius_m = 0.05
albedo = 0.4
[scene.points.path]
kind = "keyframes"
keyframes = [{ t_s = 0.0, position_m = [-4.0, 100.0, 1.0] }, { t_s = 1.0, position_m = [4.0, 100.0, -1.0] }]
[camera]
model = "ideal"
[camera.lens]
field_of_view_deg = 25.0
blur_px = 0.6
[run]
pace = "free"
seconds = 1.0
step_us = 2000
"""
LINKS = '[[links]]\nkind = "loopback"\nname = "left"\n[[links]]\nkind = "loopback"\nname = "right"\n'
SECOND = '[second_camera]\nlinks = ["right"]\noffset_m = [1.0, 0.0, 0.0]\n'


def rig(second=SECOND, scene=SCENE, links=LINKS):
    return parse_rig(scene + second + links, "my.toml", "my")


def test_the_second_camera_is_another_one_at_its_place():
    first = rig()
    assert first.second_camera == SecondCamera(("right",), offset_m=(1.0, 0.0, 0.0))
    second = second_rig(first)
    assert second.camera.serial != first.camera.serial
    assert second.run.seed != first.run.seed
    assert [link.name for link in second.links] == ["right"]
    here, there = (build_trajectory(one.scene.camera).pose(0) for one in (first, second))
    np.testing.assert_allclose(there.position_m, here.position_m + [1, 0, 0], atol=1e-12)  # its x is the world's here


@pytest.mark.parametrize(
    ("second", "told"),
    [
        ('[second_camera]\nlinks = ["middle"]\n', "middle"),
        ("[second_camera]\nlinks = []\n", "links must name"),
        ('[second_camera]\nlinks = ["left", "right"]\n', "the first camera needs a link too"),
        ('[second_camera]\nlinks = ["right"]\nserial = ""\n', "serial"),
        ('[second_camera]\nlinks = ["right"]\nmodel = "evk5"\n', "second_camera.model: 'evk5'"),
        ('[second_camera]\nlinks = ["right"]\nmodel = "evk4"\nserial = "R2D2"\n', "second_camera.serial"),
        ('[second_camera]\nlinks = ["right"]\nq_first_from_second = [1, 1, 0, 0]\n', "q_first_from_second"),
        ('[second_camera]\nlinks = ["right"]\noffset_m = [nan, 0, 0]\n', "offset_m"),
    ],
)
def test_mistakes_are_told(second, told):
    with pytest.raises(RigError, match=r"my\.toml") as error:
        rig(second)
    assert told in str(error.value)


def test_a_scene_without_a_path_has_no_place_for_a_second_camera():
    with pytest.raises(RigError, match="second_camera"):
        second_rig(rig(scene='[scene]\nkind = "checkerboard"\n'))


def test_a_rig_built_without_links_has_no_master():
    rig = dataclasses.replace(load_rig("stars-stereo"), links=())
    with pytest.raises(RigError, match="the first camera needs a link too"):
        link_setups(rig)


def test_what_is_mounted_beside_a_turning_thing_moves_as_a_rigid_body_does():
    path = build_trajectory(MountedPath(SpinPath(spin_deg_s=90.0), (2.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
    motion = path.motion(300_000_000)
    assert np.linalg.norm(motion.velocity_m_s) == pytest.approx(math.pi)
    np.testing.assert_allclose(motion.velocity_m_s, differences(path.pose, 300_000_000).velocity_m_s, atol=1e-4)
    assert np.linalg.norm(motion.acceleration_m_s2) == pytest.approx(2 * (math.pi / 2) ** 2, rel=1e-4)
    np.testing.assert_allclose(motion.turn_rad_s, [0, 0, math.pi / 2], atol=1e-12)


def test_the_shipped_rig_has_two_devices():
    shipped = load_rig("stars-stereo")
    assert {link.port for link in shipped.links} == {3240, 3241}
    assert len({shipped.camera.serial, second_rig(shipped).camera.serial}) == 2


@pytest.mark.system
def test_a_point_stands_apart_in_both_pictures_by_its_parallax_at_the_same_times(tmp_path, json_of):
    """f b / z: 780.4 px, 1 m, 100 m. Events of a point spread over a few pixels; their mean is good to 0.3 px."""
    file = tmp_path / "my.toml"
    file.write_text(SCENE + SECOND + LINKS)
    assert json_of(0, "run", file, "--record", tmp_path / "seen.npz")["balanced"]
    places = {}
    for name in ("left", "right"):
        events, resets = load_record(tmp_path / f"seen-{name}.npz")
        events = events[resets[-1] :]
        on = events[events["on"]]
        assert len(on) > 100
        places[name] = np.polyfit(on["t"] * 1e-6 - 0.5, on["x"].astype(float), 1)
    focal_px = 173 / math.tan(math.radians(12.5))
    speed, middle = places["left"] - places["right"]
    assert middle == pytest.approx(focal_px * 1.0 / 100.0, abs=0.3)
    assert abs(speed) < 1.5  # of 62 px/s: their clocks go alike, and the distance is the same
    assert places["left"][0] == pytest.approx(focal_px * 8 / 100, rel=0.03)


class _Adjusted:
    adjustable = {"threshold_on": 0.2}
    longest_step_ns = 1 << 62

    def adjust(self, name, value):
        self.adjustable = {name: value}


def test_the_second_sensor_follows_the_biases_of_its_own_hosts_alone():
    sensor = _Adjusted()
    view = CameraView(None, sensor, ReadingSources((), ()), ["right"])
    view.follow("left", CameraSettings(0, "register", {"threshold_on": 3.0}))
    assert sensor.adjustable["threshold_on"] == 0.2
    view.follow("right", CameraSettings(0, "register", {"threshold_on": 2.0}))
    assert sensor.adjustable["threshold_on"] == 0.4


OTHER = SECOND.replace("offset_m", 'model = "evk4"\noffset_m')
PULSES = '[trigger]\nperiod_ms = 100.0\nkind = "pulse"\npulse_us = 300\n'


def test_a_camera_of_another_family_has_its_own_sensor_and_no_parts_of_the_first():
    scene = SCENE.replace('"ideal"', '"dvxplorer"').replace(
        "[camera.lens]", '[camera.imu]\nunit = "bmi160"\n[camera.lens]'
    )
    second = second_rig(rig(OTHER, scene)).camera
    assert (second.model, second.size, second.imu) == ("evk4", (1280, 720), None)
    assert second.sensor == CAMERA_MODELS["evk4"].sensor
    with pytest.raises(RigError, match="same model"):
        rig(OTHER, scene + "tolerance_us = 100.0\n")


def angle_at_a_quarter_second(events, width):
    """Return the horizontal angle of what moves, in rad: the mean place of the ON events in the busiest cells."""
    on = events[events["on"] & (np.abs(events["t"].astype(float) - 0.25e6) < 0.02e6)]
    cell = on["x"] // 16 + 1000 * (on["y"] // 16).astype(int)
    counts = np.bincount(cell)
    busy = on[counts[cell] > counts.max() / 2]
    return math.atan((busy["x"].mean() - (width - 1) / 2) * math.tan(math.radians(12.5)) / (width / 2))


@pytest.mark.long
@pytest.mark.system
def test_cameras_of_two_families_see_one_point_and_the_same_pulses(tmp_path, json_of):
    """A DVXplorer, and an EVK4 1 m to its right; the point, at 100 m, is then 2 m to the left of the first one.

    It moves by 3 mrad while its events are taken, and a pixel is 0.7 mrad.
    """
    file = tmp_path / "my.toml"
    shorter = SCENE.replace("seconds = 1.0", "seconds = 0.3").replace("step_us = 2000", "step_us = 5000")
    file.write_text(shorter.replace('"ideal"', '"dvxplorer"') + PULSES + OTHER + LINKS)
    assert json_of(0, "run", file, "--record", tmp_path / "seen.npz")["balanced"]
    angles, edges = {}, {}
    for name, width in (("left", 640), ("right", 1280)):
        events, resets = load_record(tmp_path / f"seen-{name}.npz")
        angles[name] = angle_at_a_quarter_second(events[resets[-1] :], width)
        seen = load_edges(tmp_path / f"seen-{name}.npz")[0]
        edges[name] = [int(edge["t"]) for edge in seen if edge["kind"] != EdgeKind.PULSE and edge["t"] < 300_000]
    assert angles["left"] == pytest.approx(-2.0 / 100.0, abs=0.003)
    assert angles["right"] == pytest.approx(-3.0 / 100.0, abs=0.003)
    assert edges["left"] == edges["right"] == [t for k in (1, 2) for t in (100_000 * k, 100_000 * k + 300)]
