"""Velocity, acceleration and turning of trajectories, against closed forms and against differences of their poses."""

import math
from fractions import Fraction

import numpy as np
import pytest

from emulator.geometry.attitude import quaternion_of_vector
from emulator.geometry.camera import Cycle
from emulator.trajectory.ccsds_file import PolynomialPath, Segment, Segmented
from emulator.trajectory.keyframes import Keyframes
from emulator.trajectory.laws import Descent, Orbit, OrbitPath
from emulator.trajectory.live import SimulatedPath, TimedPose, known_motion
from emulator.trajectory.mounting import Looking, Mounted, PlaceAndAttitude, Spinning
from emulator.trajectory.pose import STILL, Fixed, Pose, Trajectory, differences

SECOND = 1_000_000_000
TURNED = quaternion_of_vector([0.3, -0.2, 0.5])


def _keyframes():
    times = [k * SECOND for k in range(5)]
    places = [np.array([math.sin(k), k * 0.7, math.cos(2 * k)]) for k in range(5)]
    return Keyframes(
        times, [Pose(p, quaternion_of_vector([0.3 * k, 0.1 * k * k, -0.2 * k])) for k, p in enumerate(places)]
    )


def _orbit(eccentricity=0.3):
    return Orbit(OrbitPath(4.4628e5, 35e3, eccentricity, inclination_deg=40, node_deg=20, periapsis_deg=70))


def _spinning():
    return Spinning((1, 2, 3), (0.2, -0.5, 0.8), Cycle(Fraction(1, 7)), 0.4, Cycle(Fraction(-1, 11)))


def _polynomial():
    return PolynomialPath([k * SECOND for k in range(9)], [[math.sin(k / 3), math.cos(k / 2), k] for k in range(9)], 5)


PATHS = {
    "fixed": Fixed(),
    "keyframes": _keyframes(),
    "orbit": _orbit(),
    "spinning": _spinning(),
    "polynomial": _polynomial(),
    "looking": Looking(_keyframes(), (9, -4, 7), (0.1, 0.2, 1), [0, SECOND]),
    "descent": Descent(),
    "places and attitudes": PlaceAndAttitude(_polynomial(), _spinning(), SECOND, 2 * SECOND),
    "mounted": Mounted(_keyframes(), Pose(np.zeros(3), TURNED)),
    "beside": Mounted(_keyframes(), Pose(np.array([0.3, -0.2, 1.0]), TURNED)),
    "segmented": Segmented([Segment(_keyframes(), SECOND, SECOND, 5 * SECOND)]),
}


@pytest.mark.parametrize("name", PATHS)
def test_a_closed_form_agrees_with_differences_of_poses(name):
    path = PATHS[name]
    scale_m = 1 + np.linalg.norm(path.pose(0).position_m)
    for t_ns in range(1_234_567_891, 2_900_000_000, 217_000_000):
        if min(t_ns % SECOND, SECOND - t_ns % SECOND) < 20_000_000:  # a jump of the acceleration at a keyframe
            continue
        closed, differenced = path.motion(t_ns), differences(path.pose, t_ns)
        np.testing.assert_allclose(closed.velocity_m_s, differenced.velocity_m_s, atol=1e-4, rtol=1e-5)
        np.testing.assert_allclose(closed.acceleration_m_s2, differenced.acceleration_m_s2, atol=2e-4 + 2e-11 * scale_m)
        np.testing.assert_allclose(closed.turn_rad_s, differenced.turn_rad_s, atol=3e-5)


def test_constant_acceleration_between_keyframes_is_exact():
    a, v = np.array([0.5, -2.0, 1.62]), np.array([3.0, 0.0, -7.0])
    seconds = [0.0, 1.0, 4.0]
    path = Keyframes(
        [round(t * SECOND) for t in seconds],
        [Pose(v * t + a * t * t / 2, STILL.q_world_from_body) for t in seconds],
        [v + a * t for t in seconds],
    )
    for t_ns in (0, 500_000_000, 3_999_999_999):
        motion = path.motion(t_ns)
        np.testing.assert_allclose(motion.acceleration_m_s2, a, atol=1e-12)
        np.testing.assert_allclose(motion.velocity_m_s, v + a * t_ns * 1e-9, atol=1e-12)
    np.testing.assert_array_equal(path.motion(5 * SECOND).acceleration_m_s2, 0)


class _Helix(Trajectory):
    """A circle with climb, turning with it: poses alone, so that its motion comes from differences."""

    def pose(self, t_ns):
        a = 2.0 * t_ns * 1e-9
        return Pose(np.array([100 * math.cos(a), 100 * math.sin(a), a]), quaternion_of_vector([0, 0, a]))


def test_differences_are_as_good_as_they_say():
    w, radius, h = 2.0, 100.0, 5e-3
    motion, place = _Helix().motion(1_700_000_000), _Helix().pose(1_700_000_000).position_m
    expected = -w * w * np.array([place[0], place[1], 0])
    assert np.abs(motion.acceleration_m_s2 - expected).max() < h * h / 12 * radius * w**4 + 4 * 1.2e-16 * radius / h**2
    np.testing.assert_allclose(motion.turn_rad_s, [0, 0, w], atol=4 * 1.2e-16 / h + 1e-13)
    assert np.linalg.norm(motion.velocity_m_s) == pytest.approx(math.hypot(w * radius, w), rel=h * h / 6 * w * w * 1.01)


def _samples(period_ns, count, a):
    turn = np.array([0.1, 0.2, -0.3])
    return [
        TimedPose(
            k * period_ns, Pose(a * (k * period_ns * 1e-9) ** 2 / 2, quaternion_of_vector(turn * k * period_ns * 1e-9))
        )
        for k in range(count)
    ]


def test_known_poses_of_constant_acceleration_and_rate_give_both():
    a = np.array([1.0, -2.0, 0.5])
    known = _samples(10_000_000, 6, a)
    for t_ns in (1_000_000, 10_000_000, 35_000_000, 55_000_000):
        motion = known_motion(known, t_ns)
        np.testing.assert_allclose(motion.acceleration_m_s2, a, atol=1e-8)
        np.testing.assert_allclose(motion.turn_rad_s, [0.1, 0.2, -0.3], atol=1e-10)


def test_a_simulated_path_is_at_rest_until_it_is_known_to_move():
    path = SimulatedPath(Fixed())
    assert not path.motion(0).velocity_m_s.any()
    for t_ns, pose, _ in _samples(10_000_000, 4, np.array([0, 0, 3.0])):
        path.add(t_ns, pose)
    np.testing.assert_allclose(path.motion(25_000_000).acceleration_m_s2, [0, 0, 3.0], atol=1e-8)
