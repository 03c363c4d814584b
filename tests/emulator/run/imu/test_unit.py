"""What an IMU feels on known paths, against closed forms."""

import itertools
import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from emulator.geometry.attitude import quaternion_of_vector
from emulator.geometry.camera import Cycle
from emulator.run.imu import EARTH_IN_THE_PICTURE, MOON_BELOW, WEIGHTLESS, Carried, Gravity, ImuUnit
from emulator.sensor.parameters import ImuParameters
from emulator.trajectory.keyframes import Keyframes
from emulator.trajectory.laws import Orbit, OrbitPath
from emulator.trajectory.live import LATE_PICTURES, LivePoses
from emulator.trajectory.mounting import Looking, Spinning
from emulator.trajectory.pose import STILL, Fixed, Pose, Timescale
from firmware_protocol.pose_message import PoseMessage

SECOND = 1_000_000_000
NONE = (0.0, 0.0, 0.0)
PERFECT = ImuParameters(
    gyroscope_noise_deg_s=0.0,
    accelerometer_noise_ug=0.0,
    gyroscope_walk_deg_s=0.0,
    accelerometer_walk_g=0.0,
    gyroscope_bias_deg_s=NONE,
    accelerometer_bias_g=NONE,
    clock_ppm=0.0,
)


def unit(path, gravity=WEIGHTLESS, factor=1.0, seed=1, parameters=PERFECT):
    return ImuUnit(parameters, Carried(path, gravity, Timescale(factor)), seed)


def test_samples_come_once_a_millisecond_of_the_units_own_clock():
    motion = unit(Fixed()).between(0, 10_000_000)
    assert motion["t"].tolist() == [1000 * k for k in range(1, 11)]
    assert motion["index"].tolist() == list(range(1, 11))
    fast = unit(Fixed(), parameters=replace(PERFECT, clock_ppm=1500.0)).between(0, SECOND)
    assert len(fast) == 1001
    assert set(np.diff(fast["t"].astype(int)).tolist()) == {998, 999}  # as measured on a real DAVIS346


def test_on_the_ground_it_feels_what_holds_it_up():
    motion = unit(Fixed(), EARTH_IN_THE_PICTURE).between(0, 1_000_000)
    np.testing.assert_allclose(motion["force"][0], [0, -9.80665, 0])
    np.testing.assert_array_equal(motion["rate"][0], 0)


def test_in_orbit_it_feels_nothing():
    elements = OrbitPath(4.4628e5, 35e3, 0.4)
    path = Looking(Orbit(elements), (0, 0, 0), (0, 0, 1), [0, SECOND])
    motion = unit(path, Gravity(gm_m3_s2=elements.gm_m3_s2)).between(5000 * SECOND, 5000 * SECOND + 3_000_000)
    np.testing.assert_allclose(motion["force"], 0, atol=1e-17)
    assert np.linalg.norm(motion["rate"][0]) > 0


def test_in_fast_motion_free_fall_stays_free_and_turning_is_faster():
    elements = OrbitPath(4.4628e5, 35e3)
    path = Looking(Orbit(elements), (0, 0, 0), (0, 0, 1), [0, SECOND])
    motion = unit(path, Gravity(gm_m3_s2=elements.gm_m3_s2), factor=1000.0).between(0, 1_000_000)
    np.testing.assert_allclose(motion["force"], 0, atol=1e-11)
    np.testing.assert_allclose(motion["rate"][0], [0, -1000 * elements.mean_motion_rad_s, 0], atol=1e-9)


def test_on_a_circle_it_feels_the_centripetal_force_along_its_axes():
    """Looking at the middle, the force is w^2 r along the boresight."""
    elements = OrbitPath(4.4628e5, 35e3)
    path = Looking(Orbit(elements), (0, 0, 0), (0, 0, 1), [0, SECOND])
    force = unit(path).between(0, 1_000_000)["force"][0]
    np.testing.assert_allclose(force, [0, 0, elements.mean_motion_rad_s**2 * 35e3], atol=1e-12)


def test_constant_acceleration_adds_to_gravity():
    a = np.array([0.5, -2.0, 1.0])
    poses = [Pose(a * t * t / 2, STILL.q_world_from_body) for t in (0.0, 2.0)]
    path = Keyframes([0, 2 * SECOND], poses, [a * 0, a * 2])
    force = unit(path, MOON_BELOW).between(0, SECOND)["force"]
    np.testing.assert_allclose(force, np.broadcast_to(a + [0, 0, 1.62], force.shape), atol=1e-11)


def test_a_turn_about_one_axis_and_a_turned_mounting():
    spin = Spinning(NONE, (0, 0, 1), Cycle(Fraction(1, 4)))
    np.testing.assert_allclose(unit(spin).between(0, SECOND)["rate"][-1], [0, 0, math.pi / 2], atol=1e-14)
    quarter_about_x = tuple(quaternion_of_vector([math.pi / 2, 0, 0]))  # the unit's y lies along the camera's z
    turned = unit(spin, parameters=replace(PERFECT, q_camera_from_imu=quarter_about_x))
    np.testing.assert_allclose(turned.between(0, SECOND)["rate"][-1], [0, math.pi / 2, 0], atol=1e-14)


def test_live_poses_are_felt_and_no_picture_is_counted_as_late():
    path = LivePoses()
    for k in range(6):
        place = (0.0, 0.0, 1.5 * (k / 100) ** 2)
        path.add(PoseMessage(k * 10_000_000, place, (1.0, 0.0, 0.0, 0.0), counter=k), 10**9)
    force = unit(path).between(20_000_000, 400_000_000)["force"]
    np.testing.assert_allclose(force[:30], np.broadcast_to([0, 0, 3.0], (30, 3)), atol=1e-7)
    np.testing.assert_array_equal(force[-1], 0)
    assert path.counters[LATE_PICTURES] == 0


@pytest.mark.parametrize("cuts", [[], [0.3], [0.0011, 0.0012, 0.5, 0.501]])
def test_samples_do_not_depend_on_steps_or_restarts(cuts):
    noisy = ImuParameters()
    whole = unit(Fixed(), parameters=noisy).between(0, SECOND)
    edges = [0, *(round(c * SECOND) for c in cuts), SECOND]
    one = unit(Fixed(), parameters=noisy)
    parts = [one.between(a, b) for a, b in itertools.pairwise(edges)]
    again = unit(Fixed(), parameters=noisy).between(SECOND // 2, SECOND)
    assert np.concatenate(parts).tobytes() == whole.tobytes()
    assert again.tobytes() == whole[-len(again) :].tobytes()


def test_seeds_differ_and_given_biases_stay():
    one, other = (unit(Fixed(), parameters=ImuParameters(), seed=s).between(0, 1_000_000) for s in (1, 2))
    assert (one["rate"] != other["rate"]).all()
    biased = replace(PERFECT, gyroscope_bias_deg_s=(1.0, 2.0, -3.0), accelerometer_bias_g=(0.1, 0.0, 0.0))
    motion = unit(Fixed(), parameters=biased).between(0, 1_000_000)
    np.testing.assert_allclose(motion["rate"][0], np.radians([1, 2, -3]))
    np.testing.assert_allclose(motion["force"][0], [0.980665, 0, 0])


@pytest.mark.parametrize(
    ("table", "word"),
    [
        ({"gyroscope_noise_deg_s": -1.0}, "gyroscope_noise_deg_s"),
        ({"temperature_c": math.nan}, "temperature_c"),
        ({"q_camera_from_imu": (1.0, 1.0, 0.0, 0.0)}, "q_camera_from_imu"),
        ({"gravity_m_s2": (0.0, 0.0, -1.6), "gm_m3_s2": 1.0}, "gm_m3_s2"),
        ({"gravity_m_s2": (0.0, math.nan, 0.0)}, "gravity_m_s2"),
        ({"gm_m3_s2": math.inf}, "gm_m3_s2"),
    ],
)
def test_a_bad_table_is_refused_by_name(table, word):
    with pytest.raises(ValueError, match=word):
        ImuParameters(**table)
