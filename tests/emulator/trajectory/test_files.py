"""Tables, CCSDS files and flight files; what is wrong is told with its line."""

import contextlib
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.trajectory.building import build_trajectory, parse_flight, parse_table
from emulator.trajectory.ccsds_file import parse_aem, parse_oem
from emulator.trajectory.parameters import FilePath, FixedPath, Keyframe, KeyframePath, LivePath, OrbitPath, SpinPath
from emulator.trajectory.pose import Pose, TrajectoryError, turn_rad

S = 1_000_000_000
HALF = 2**-0.5

OEM = """CCSDS_OEM_VERS = 2.0
CREATION_DATE = 2000-04-30T00:00:00
ORIGINATOR = US
META_START
OBJECT_NAME = NEAR
CENTER_NAME = EROS
REF_FRAME = ICRF
TIME_SYSTEM = UTC
META_STOP
COMMENT a comment 1 2 3
2000-04-30T12:00:00.0 50.0 0.0 0.0 0.0 0.003 0.0
2000-121T12:00:10.5 50.0 0.0315 0.0 0.0 0.003 0.0
COVARIANCE_START
1.0
COVARIANCE_STOP
"""

AEM = """CCSDS_AEM_VERS = 1.0
META_START
REF_FRAME_A = ICRF
REF_FRAME_B = SC_BODY_1
ATTITUDE_DIR = {direction}
ATTITUDE_TYPE = QUATERNION
QUATERNION_TYPE = {order}
META_STOP
DATA_START
2000-04-30T12:00:00 {first}
2000-04-30T12:00:10 {first}
DATA_STOP
"""


def test_a_table_with_columns_in_any_order():
    samples = parse_table("# a comment\nx_m,y_m,z_m,t_s,qz,qy,qx,qw,mood\n1,2,3,0.5,0,0,1,0,good\n")
    assert samples.times_ns == [S // 2]
    np.testing.assert_array_equal(samples.poses[0].position_m, [1, 2, 3])
    np.testing.assert_array_equal(samples.poses[0].q_world_from_body, [0, 1, 0, 0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty trajectory"),
        ("t_s,x_m,y_m\n", "line 1: column z_m is missing"),
        ("t_s,x_m,y_m,z_m\n0,1,2\n", "line 2:"),
        ("t_s,x_m,y_m,z_m\n\n0,1,2,two\n", "line 3: could not convert"),
        ("t_s,x_m,y_m,z_m,qw,qx,qy,qz\n0,1,2,3,1,1,0,0\n", "line 2: an attitude is a unit quaternion"),
        ("t_s,x_m,y_m,z_m\ninf,1,2,3\n", "line 2: time inf"),
    ],
)
def test_a_table_s_mistake_is_told_with_its_line(text, message):
    with pytest.raises(TrajectoryError, match=message):
        parse_table(text)


@given(st.text(max_size=200))
def test_no_text_makes_a_reader_fail_otherwise(text):
    for read in (parse_table, parse_oem, parse_aem, lambda t: parse_flight(t, 1.0)):
        with contextlib.suppress(TrajectoryError):
            assert read("t_s,x_m,y_m,z_m\n" + text) is not None


def test_an_orbit_file_with_velocities_in_both_ways_to_write_a_date():
    path = parse_oem(OEM).path
    start, stop = path.span_ns
    assert stop - start == 10_500_000_000
    np.testing.assert_allclose(path.pose(stop).position_m, [50_000, 31.5, 0])
    np.testing.assert_allclose(path.pose(start + S // 100).position_m, [50_000, 0.03, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("2000-04-30T12:00:00.0", "30.4.2000"), "line 11: epoch '30.4.2000'"),
        (("0.0 0.0 0.0 0.003 0.0\n2000-121", "0.0\n2000-121"), "line 11: an epoch and 3, 6 or 9 numbers"),
        (("2000-121T12:00:10.5 50.0", "2000-121T12:00:10.5 fifty"), "line 12: could not convert"),
    ],
)
def test_an_orbit_file_s_mistake_is_told_with_its_line(change, message):
    with pytest.raises(TrajectoryError, match=message):
        parse_oem(OEM.replace(*change))


@pytest.mark.parametrize(
    ("direction", "order", "first"),
    [
        ("A2B", "LAST", f"0 0 {HALF} {HALF}"),
        ("A2B", "FIRST", f"{HALF} 0 0 {HALF}"),
        ("B2A", "LAST", f"0 0 {-HALF} {HALF}"),
    ],
)
def test_an_attitude_file_in_any_direction_and_order(direction, order, first):
    pose = parse_aem(AEM.format(direction=direction, order=order, first=first)).path.pose(0)
    # The spacecraft is turned by a quarter about z: its x axis points along the world's y.
    np.testing.assert_allclose(pose.world_from_body @ [1, 0, 0], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize(("direction", "sign"), [("A2B", -1), ("B2A", 1)])
def test_an_attitude_file_whose_first_frame_is_the_spacecraft(direction, sign):
    text = AEM.format(direction=direction, order="LAST", first=f"0 0 {HALF} {HALF}")
    text = text.replace("REF_FRAME_A = ICRF", "REF_FRAME_A = SC_BODY_1").replace("_B = SC_BODY_1", "_B = ICRF")
    pose = parse_aem(text).path.pose(0)
    np.testing.assert_allclose(pose.world_from_body @ [1, 0, 0], [0, sign, 0], atol=1e-12)


def test_euler_angles_are_not_read():
    text = AEM.format(direction="A2B", order="LAST", first="0 0 0 1").replace("= QUATERNION\n", "= EULER_ANGLE\n", 1)
    with pytest.raises(TrajectoryError, match="line 10: ATTITUDE_TYPE EULER_ANGLE is not read"):
        parse_aem(text)


def test_a_flight_file():
    text = "start 0 0 100 90 -90 0  # down\n1 0 0 0 0 0\npause 2\n\nquaternion 5 6 7 1 0 0 0\nsun_position 1 2 3\n"
    flight = parse_flight(text, 0.1)
    poses = flight.poses
    assert flight.times_ns == [0, S // 10, S // 10 + 2 * S, S // 10 + 2 * S + S // 10]
    np.testing.assert_allclose(poses[0].world_from_body @ [0, 0, 1], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(poses[0].world_from_body @ [0, -1, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(poses[1].position_m, [1, 0, 100])
    np.testing.assert_allclose(poses[3].position_m, [5, 6, 7])
    assert flight.left_out == {"sun_position": 1}


@pytest.mark.parametrize("text", ["1 0 0 0 0 0", "start 1 2 3", "pause 1", "start 0 0 0 0 0 nan"])
def test_a_flight_file_s_mistake_is_told_with_its_line(text):
    with pytest.raises(TrajectoryError, match="line 1: "):
        parse_flight(text, 0.1)


def test_rigs_build_every_kind(tmp_path):
    (tmp_path / "path.oem").write_text(OEM)
    (tmp_path / "path.aem").write_text(AEM.format(direction="A2B", order="LAST", first=f"0 0 {HALF} {HALF}"))
    file = build_trajectory(FilePath(str(tmp_path / "path.oem"), str(tmp_path / "path.aem"), axes="opengl"))
    np.testing.assert_allclose(file.pose(0).position_m, [50_000, 0, 0])
    np.testing.assert_allclose(file.pose(0).world_from_body @ [0, 0, 1], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(file.pose(0).world_from_body @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    keyframes = KeyframePath((Keyframe(0.0, (0, 0, 0)), Keyframe(1.0, (1, 0, 0))), look_at_m=(0, 9, 0))
    np.testing.assert_allclose(build_trajectory(keyframes).pose(0).world_from_body @ [0, 0, 1], [0, 1, 0], atol=1e-9)
    orbit = build_trajectory(OrbitPath(4.4628e5, 50_000.0)).pose(0)
    np.testing.assert_allclose(orbit.world_from_body @ [0, 0, 1], [-1, 0, 0], atol=1e-9)
    spin = build_trajectory(SpinPath(spin_deg_s=90.0))
    assert turn_rad(spin.pose(0), spin.pose(S)) == pytest.approx(math.pi / 2)
    assert isinstance(build_trajectory(FixedPath()).pose(0), Pose)


def test_what_a_flight_file_holds_beside_poses_is_told(tmp_path, caplog):
    (tmp_path / "a.fli").write_text("sun_position 1 2 3\nquaternion 5 6 7 1 0 0 0\nsun_position 3 2 1\n")
    with caplog.at_level("INFO"):
        assert build_trajectory(FilePath(str(tmp_path / "a.fli"))).pose(0).position_m[2] == 7
    assert "left out of the flight: 2 sun_position" in caplog.text


def test_a_live_path_from_a_rig_listens():
    path = build_trajectory(LivePath(port=0))
    assert path.receiver.address[1] > 0
    path.receiver.close()


@pytest.mark.parametrize(("name", "message"), [("a.txt", "name it .csv, .oem or .fli"), ("none.csv", "cannot be read")])
def test_a_file_that_cannot_be_used(tmp_path, name, message):
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(TrajectoryError, match=f"{name}: .*{message}"):
        build_trajectory(FilePath(str(tmp_path / name)))


@pytest.mark.parametrize(
    "make",
    [
        lambda: FixedPath(q_world_from_body=(2, 0, 0, 0)),
        lambda: FixedPath(position_m=(math.nan, 0, 0)),
        lambda: SpinPath(pole=(0, 0, 0)),
        lambda: FilePath(),
        lambda: LivePath(port=70000),
        lambda: LivePath(hold_ms=-1.0),
        lambda: LivePath(ahead_ms=1e6),
        lambda: FilePath("a.fli", period_s=0.0),
    ],
)
def test_a_rig_s_nonsense_is_refused(make):
    with pytest.raises(ValueError, match=r" is |must be"):
        make()
