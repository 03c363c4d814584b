"""Orbit and attitude files: each at its own epochs, interpolated as asked, and nothing guessed in silence."""

import math

import numpy as np
import pytest

from emulator.trajectory.building import build_trajectory
from emulator.trajectory.ccsds_file import epoch_ns, parse_aem, parse_oem
from emulator.trajectory.parameters import FilePath
from emulator.trajectory.pose import TrajectoryError

S = 1_000_000_000
GM, A = 398600.4418, 7000.0  # km3/s2, km: a low orbit about the Earth
MOTION = math.sqrt(GM / A**3)


def clock(seconds, day="2020-01-01"):
    whole, rest = divmod(seconds, 1)
    return f"{day}T{int(whole) // 3600:02}:{int(whole) // 60 % 60:02}:{int(whole) % 60:02}.{int(rest * 1000):03}"


def oem(*segments, head="REF_FRAME = ICRF\nTIME_SYSTEM = UTC\n"):
    """Each segment: extra metadata and data lines."""
    return "".join(f"META_START\n{head}{meta}META_STOP\n" + "\n".join(lines) + "\n" for meta, lines in segments)


def orbit(times, velocities=True):
    lines = []
    for t in times:
        c, s = math.cos(MOTION * t), math.sin(MOTION * t)
        values = [A * c, A * s, 0.0] + ([-A * MOTION * s, A * MOTION * c, 0.0] if velocities else [])
        lines.append(f"{clock(t)} " + " ".join(f"{v:.12f}" for v in values))
    return lines


def true_m(t):
    return 1000 * A * np.array([math.cos(MOTION * t), math.sin(MOTION * t), 0.0])


def aem(yaws, meta="REF_FRAME_A = ICRF\nREF_FRAME_B = SC_BODY_1\n"):
    """Attitudes (seconds, degrees about z)."""
    lines = []
    for t, yaw in yaws:
        half = math.radians(yaw) / 2
        lines.append(f"{clock(t)} 0 0 {math.sin(half):.12f} {math.cos(half):.12f}")
    return f"META_START\n{meta}META_STOP\nDATA_START\n" + "\n".join(lines) + "\nDATA_STOP\n"


def yaw_deg(pose):
    x = pose.world_from_body[:, 0]
    return math.degrees(math.atan2(x[1], x[0]))


def built(tmp_path, orbit_text, attitude_text):
    (tmp_path / "a.oem").write_text(orbit_text)
    (tmp_path / "a.aem").write_text(attitude_text)
    return build_trajectory(FilePath(str(tmp_path / "a.oem"), str(tmp_path / "a.aem")))


def test_attitudes_between_the_epochs_of_places_are_not_lost(tmp_path):
    """Places every 5 minutes, attitudes every minute, back and forth: at 2.5 min the yaw is 30 degrees."""
    back_and_forth = [(0, 0), (60, 12), (120, 24), (150, 30), (180, 24), (240, 12), (300, 0)]
    path = built(tmp_path, oem(("", orbit([0, 300]))), aem(back_and_forth))
    assert yaw_deg(path.pose(150 * S)) == pytest.approx(30.0, abs=1e-6)
    assert yaw_deg(path.pose(60 * S)) == pytest.approx(12.0, abs=1e-6)


def test_files_in_different_time_systems_are_brought_together(tmp_path):
    """TT is ahead of UTC by 69.184 s in 2020: the attitude of 00:01:09.184 TT is that of 00:00:00 UTC."""
    turning = aem([(0, 0), (60, 12), (120, 24)], "REF_FRAME_A=ICRF\nREF_FRAME_B=SC_BODY_1\nTIME_SYSTEM = TT\n")
    path = built(tmp_path, oem(("", orbit([0, 50]))), turning)
    assert yaw_deg(path.pose(0)) == pytest.approx(69.184 / 5, abs=1e-6)


@pytest.mark.parametrize(
    ("meta", "message"),
    [
        ("REF_FRAME_A = ICRF\nREF_FRAME_B = SC\nTIME_SYSTEM = MET\n", "TIME_SYSTEM is MET"),
        ("REF_FRAME_A = SC\nREF_FRAME_B = TOD\n", "frame is TOD"),
    ],
)
def test_files_that_cannot_be_compared_are_refused(tmp_path, meta, message):
    with pytest.raises(TrajectoryError, match=f"a.aem: its .*{message}"):
        built(tmp_path, oem(("", orbit([0, 300]))), aem([(0, 0), (300, 30)], meta))


def test_attitudes_of_another_day_are_refused_and_missing_ones_told(tmp_path, caplog):
    with pytest.raises(TrajectoryError, match="do not overlap"):
        built(tmp_path, oem(("", orbit([0, 300]))), aem([(301, 0), (400, 30)]))
    path = built(tmp_path, oem(("", orbit([0, 300]))), aem([(100, 10), (290, 30)]))
    assert "no attitudes for 100 s at the beginning and 10 s at the end" in caplog.text
    assert yaw_deg(path.pose(0)) == pytest.approx(10.0, abs=1e-6)


@pytest.mark.parametrize("body", ["SC_BODY_1", "CAMERA_1", "NEAR_MSI", "SC-BODY-1", "NEAR_SPACECRAFT", "INSTRUMENT_A"])
@pytest.mark.parametrize("world", ["ICRF", "EME2000", "J2000", "GCRF", "MCI", "IAU_EROS", "icrf3", "ITRF2014"])
@pytest.mark.parametrize("direction", ["A2B", "B2A"])
def test_the_world_s_frame_is_known_whatever_the_body_s_is_called(body, world, direction):
    """With A the body and A2B the numbers are world from body's own, which turn coordinates of the body."""
    meta = f"ATTITUDE_DIR = {direction}\n"
    first = parse_aem(aem([(0, 40)], f"REF_FRAME_A = {body}\nREF_FRAME_B = {world}\n{meta}")).path.pose(0)
    second = parse_aem(aem([(0, 40)], f"REF_FRAME_A = {world}\nREF_FRAME_B = {body}\n{meta}")).path.pose(0)
    sign = 1 if direction == "A2B" else -1
    assert (yaw_deg(first), yaw_deg(second)) == (pytest.approx(-40 * sign), pytest.approx(40 * sign))


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ("REF_FRAME_A = LVLH\nREF_FRAME_B = SC_BODY_1\n", "neither is known as the world's"),
        ("REF_FRAME_A = ICRF\nREF_FRAME_B = EME2000\n", "both are known as the world's"),
        ("REF_FRAME_A = ICRF_CAMERA\nREF_FRAME_B = SC_BODY_1\n", "neither is"),
        ("", "REF_FRAME_A = missing"),
    ],
)
def test_frames_that_do_not_tell_the_world_are_refused(frames, message):
    with pytest.raises(TrajectoryError, match=f"line .: .*{message}"):
        parse_aem(aem([(0, 40)], frames))


def test_segments_may_share_an_epoch_and_nothing_is_joined_across_it():
    """A manoeuvre at 300 s: the places before and after it lie on lines that meet at an angle."""
    before = [f"{clock(t)} {t} 0 0" for t in (0, 100, 200, 300)]
    after = [f"{clock(t)} 300 {t - 300} 0" for t in (300, 400, 500)]
    path = parse_oem(oem(("", before), ("", after))).path
    zero = path.span_ns[0]
    np.testing.assert_allclose(path.pose(zero + 290 * S).position_m, [290_000, 0, 0], atol=1e-6)
    np.testing.assert_allclose(path.pose(zero + 310 * S).position_m, [300_000, 10_000, 0], atol=1e-6)
    assert path.bounds.speed_m_s == pytest.approx(1250)


@pytest.mark.parametrize(("start", "problem"), [(310, "starts 10 s after"), (290, "starts 10 s before")])
def test_segments_that_leave_a_gap_or_overlap_are_refused(start, problem):
    lines = [f"{clock(t)} {t} 0 0" for t in (0, 300)], [f"{clock(t)} {t} 0 0" for t in (start, 500)]
    with pytest.raises(TrajectoryError, match=f"segment 2 {problem} the end of the one before"):
        parse_oem(oem(*(("", part) for part in lines)))


@pytest.mark.parametrize("change", ["REF_FRAME = TOD", "TIME_SYSTEM = TAI", "CENTER_NAME = MARS"])
def test_a_frame_or_time_system_that_changes_is_refused(change):
    name, _, value = change.partition(" = ")
    with pytest.raises(TrajectoryError, match=f"segment at line 12: {name} is {value}"):
        parse_oem(oem(("", orbit([0, 60])), (change + "\n", orbit([60, 120]))))


def remainder_m(nodes, around, step_s):
    """Return the error of a polynomial through a circle at `nodes` steps, at its worst place `around` them."""
    product = max(abs(math.prod(x - node for node in nodes)) for x in around)
    n = len(nodes)
    return 1000 * A * (MOTION * step_s) ** n * product / math.factorial(n)


FIRST_HALF, MIDDLE = np.linspace(0, 1, 101), np.linspace(-0.5, 0.5, 101)


@pytest.mark.parametrize(
    ("asked", "velocities", "expected_m"),
    [
        ("INTERPOLATION = LAGRANGE\nINTERPOLATION_DEGREE = 7\n", False, remainder_m(range(-3, 5), FIRST_HALF, 240)),
        ("INTERPOLATION = LAGRANGE\nINTERPOLATION_DEGREE = 8\n", True, remainder_m(range(-4, 5), MIDDLE, 240)),
        ("INTERPOLATION = HERMITE\nINTERPOLATION_DEGREE = 7\n", True, remainder_m([-1, 0, 1, 2] * 2, FIRST_HALF, 240)),
        ("INTERPOLATION = HERMITE\nINTERPOLATION_DEGREE = 3\n", True, remainder_m([0, 1] * 2, FIRST_HALF, 240)),
        ("", True, remainder_m([0, 1] * 2, FIRST_HALF, 240)),
        ("INTERPOLATION = Linear\n", True, remainder_m([0, 1], FIRST_HALF, 240)),
    ],
)
def test_places_are_interpolated_as_asked(asked, velocities, expected_m):
    """A circular orbit, far from the ends, against the remainders of polynomials."""
    path = parse_oem(oem((asked, orbit(np.arange(0, 7201, 240), velocities)))).path
    inner = np.arange(2400, 4800, 7.0)
    errors = [np.linalg.norm(path.pose(path.span_ns[0] + round(t * S)).position_m - true_m(t)) for t in inner]
    assert max(errors) == pytest.approx(expected_m, rel=0.03)


@pytest.mark.parametrize("degree", [1, 2, 3, 4, 7, 12, 15])
@pytest.mark.parametrize("kind", ["LAGRANGE", "HERMITE"])
def test_a_polynomial_of_the_degree_is_followed_exactly_at_uneven_times(kind, degree):
    """Also at the ends, and at the samples themselves."""
    times = np.cumsum([0, 10, 12, 7, 10, 3, 14, 10, 9, 10, 11, 10, 8, 10, 12, 10, 10, 11])
    curve = np.polynomial.Chebyshev(np.linspace(1, 2, degree + 1), domain=(0, times[-1]))
    lines = [f"{clock(t)} {curve(t):.15e} 0 0 {curve.deriv()(t):.15e} 0 0" for t in times]
    asked = f"INTERPOLATION = {kind}\nINTERPOLATION_DEGREE = {degree}\n"
    path = parse_oem(oem((asked, lines))).path
    for t in [0.0, *np.arange(0.5, times[-1], 1.7), *times]:
        place = path.pose(path.span_ns[0] + round(t * S)).position_m
        assert place[0] == pytest.approx(1000 * curve(t), abs=1e-4)


@pytest.mark.parametrize(
    ("asked", "velocities", "message"),
    [
        ("INTERPOLATION = LAGRANGE\n", True, "needs INTERPOLATION_DEGREE"),
        ("INTERPOLATION = LAGRANGE\nINTERPOLATION_DEGREE = 7\n", True, "degree 7 needs 8 samples, and there are 4"),
        ("INTERPOLATION = LAGRANGE\nINTERPOLATION_DEGREE = 99\n", True, "1 to 25 can be used"),
        ("INTERPOLATION = HERMITE\nINTERPOLATION_DEGREE = 3\n", False, "needs velocities"),
        ("INTERPOLATION = CHEBYSHEV\n", True, "one of LINEAR, LAGRANGE and HERMITE"),
        ("USEABLE_START_TIME = 2020-01-01T01:00:00\n", True, "no sample lies between"),
    ],
)
def test_interpolation_that_cannot_be_done_is_refused(asked, velocities, message):
    with pytest.raises(TrajectoryError, match=rf"segment at line \d: .*{message}"):
        parse_oem(oem((asked, orbit([0, 60, 120, 180], velocities))))


def test_samples_beyond_the_useable_times_only_help_to_interpolate():
    asked = (
        "USEABLE_START_TIME = 2020-01-01T00:02:00\nUSEABLE_STOP_TIME = 2020-01-01T00:08:30.5\n"
        "INTERPOLATION = LAGRANGE\nINTERPOLATION_DEGREE = 7\n"
    )
    path = parse_oem(oem((asked, orbit(range(0, 601, 60), velocities=False)))).path
    start, stop = path.span_ns
    assert stop - start == 390_500_000_000
    np.testing.assert_allclose(path.pose(start).position_m, true_m(120), atol=1e-3)
    np.testing.assert_allclose(path.pose(start + 10 * S).position_m, true_m(130), atol=1e-3)
    np.testing.assert_allclose(path.pose(stop + 60 * S).position_m, true_m(510.5), atol=0.1)


def test_an_attitude_s_method_that_is_not_done_is_told(tmp_path, caplog):
    meta = "REF_FRAME_A = ICRF\nREF_FRAME_B = SC_BODY_1\nINTERPOLATION_METHOD = LINEAR\n"
    with caplog.at_level("INFO"):
        built(tmp_path, oem(("", orbit([0, 300]))), aem([(0, 0), (300, 30)], meta))
    assert "INTERPOLATION_METHOD LINEAR: attitudes lie on a spline" in caplog.text


def test_a_leap_second_takes_its_second():
    lines = [f"{text} {x} 0 0" for text, x in (
        ("2016-12-31T23:59:58", 0), ("2016-12-31T23:59:60", 2), ("2017-001T00:00:01", 4))]  # fmt: skip
    path = parse_oem(oem(("", lines))).path
    assert path.span_ns[1] - path.span_ns[0] == 4 * S
    assert path.pose(path.span_ns[0] + 3 * S).position_m[0] == pytest.approx(3000)
    tai = parse_oem(oem(("", [lines[0], lines[2]]), head="REF_FRAME = ICRF\nTIME_SYSTEM = TAI\n")).path
    assert tai.span_ns[1] - tai.span_ns[0] == 3 * S


@pytest.mark.parametrize(
    ("text", "system"),
    [
        ("2016-12-31T23:59:60", "TAI"),
        ("2016-12-30T23:59:60", "UTC"),
        ("2016-12-31T23:58:60", "UTC"),
        ("2016-12-31T23:59:61", "UTC"),
        ("2019-12-31T23:59:60", "UTC"),
    ],
)
def test_a_leap_second_that_never_was_is_refused(text, system):
    with pytest.raises(ValueError, match=f"no leap second in {system}"):
        epoch_ns(text, system)


@pytest.mark.parametrize(
    ("utc", "system", "ahead_s"),
    [
        ("1972-01-01T00:00:00", "TAI", 10),
        ("1999-01-01T00:00:00", "TAI", 32),
        ("1998-12-31T23:59:59", "TAI", 31),
        ("2020-06-01T12:00:00", "TAI", 37),
        ("2020-06-01T12:00:00", "GPS", 18),
        ("2020-06-01T12:00:00", "TT", 69.184),
        ("2000-01-01T12:00:00", "TDB", 64.184),
    ],
)
def test_time_systems_differ_by_what_the_standards_bodies_say(utc, system, ahead_s):
    """The same reading of another clock is an earlier instant, as that clock is ahead of UTC."""
    assert epoch_ns(utc, "UTC") - epoch_ns(utc, system) == round(ahead_s * S)
