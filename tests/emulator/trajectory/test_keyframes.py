"""Splines through poses, against polynomials, great circles and scipy."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from emulator.trajectory.keyframes import Keyframes
from emulator.trajectory.pose import STILL, Pose, TrajectoryError, turn_rad

S = 1_000_000_000


def at(x, y=0.0, z=0.0, angle=0.0):
    return Pose(np.array([x, y, z]), np.array([math.cos(angle / 2), 0, 0, math.sin(angle / 2)]))


def test_a_parabola_is_followed_exactly_at_uneven_times():
    times = [0, 1 * S, 3 * S, 7 * S]
    path = Keyframes(times, [at((t / S) ** 2, 3 - t / S) for t in times])
    for t in (0.5, 2.2, 6.9):
        np.testing.assert_allclose(path.pose(round(t * S)).position_m, [t * t, 3 - t, 0], atol=1e-9)


def test_given_velocities_make_a_cubic():
    t = np.array([0.0, 2.0])
    velocities = np.column_stack([3 * t**2, 0 * t, 0 * t])
    assert Keyframes([0, 2 * S], [at(0.0), at(8.0)], velocities).pose(S).position_m[0] == pytest.approx(1.0)


@pytest.mark.parametrize("degrees", [10, 45, 90, 119])
def test_a_turn_is_the_great_circle(degrees):
    ends = [at(0, angle=0.0), at(0, angle=math.radians(degrees))]
    path = Keyframes([0, S], ends)
    slerp = Slerp([0, 1], Rotation.from_quat([e.q_world_from_body for e in ends], scalar_first=True))
    worst = max(
        turn_rad(path.pose(round(x * S)), Pose(np.zeros(3), slerp(x).as_quat(scalar_first=True)))
        for x in np.linspace(0, 1, 21)
    )
    assert worst < 1e-7  # turn_rad itself is good to a few 1e-8
    assert turn_rad(path.pose(S // 4), ends[0]) == pytest.approx(math.radians(degrees) / 4, abs=1e-7)


@pytest.mark.parametrize("step_deg", [45, 100])
def test_a_steady_turn_about_an_axis_is_followed_exactly_at_uneven_times(step_deg):
    axis, times = np.array([0.6, 0.0, 0.8]), [0, 1, 1.7, 2.6, 3.0]
    rate = math.radians(step_deg)

    def truth(t):
        return Pose(np.zeros(3), Rotation.from_rotvec(rate * t * axis).as_quat(scalar_first=True))

    path = Keyframes([round(t * S) for t in times], [truth(t) for t in times])
    assert max(turn_rad(path.pose(round(t * S)), truth(t)) for t in np.linspace(0, 3, 61)) < 1e-7


def coning(t):
    """A body that turns about an axis which itself goes round another."""
    turn = Rotation.from_rotvec([0, 0, 0.9 * t]) * Rotation.from_rotvec([0.5, 0, 0]) * Rotation.from_rotvec([0, 0, t])
    return Pose(np.zeros(3), turn.as_quat(scalar_first=True))


def test_the_error_of_a_smooth_turn_falls_with_the_fourth_power_of_the_step():
    worst = []
    for step in (0.4, 0.2, 0.1):
        times = np.arange(0, 8 + step / 2, step)
        path = Keyframes([round(t * S) for t in times], [coning(t) for t in times])
        worst.append(max(turn_rad(path.pose(round(t * S)), coning(t)) for t in np.arange(2, 6, step / 7)))
    assert worst[0] / worst[1] > 10
    assert worst[1] / worst[2] > 10


@given(st.lists(st.tuples(st.floats(-50, 50), st.floats(-1, 1)), min_size=2, max_size=8), st.floats(0, 1))
def test_it_passes_through_its_keyframes_and_keeps_its_bounds(steps, x):
    times = [k * S for k in range(len(steps))]
    path = Keyframes(times, [at(place, angle=angle) for place, angle in steps])
    for t, (place, angle) in zip(times, steps, strict=True):
        assert path.pose(t).position_m[0] == pytest.approx(place, abs=1e-9)
        assert turn_rad(path.pose(t), at(0, angle=angle)) < 1e-7
    t0 = round(x * (times[-1] - 1000))
    before, after = path.pose(t0), path.pose(t0 + 1000)
    assert np.linalg.norm(after.position_m - before.position_m) * 1e6 <= path.bounds.speed_m_s * 1.001 + 1e-6
    assert turn_rad(before, after) * 1e6 <= path.bounds.turn_rad_s * 1.001 + 1e-6


def test_a_quaternion_s_sign_does_not_matter():
    turned = at(0, angle=0.3)
    flipped = Pose(turned.position_m, -turned.q_world_from_body)
    one, other = (Keyframes([0, S], [STILL, end]) for end in (turned, flipped))
    assert turn_rad(one.pose(S // 3), other.pose(S // 3)) < 1e-9


def test_one_keyframe_is_a_place():
    path = Keyframes([5], [at(4.0)])
    assert path.pose(-7).position_m[0] == 4.0
    assert path.bounds.speed_m_s == 0


@pytest.mark.parametrize(
    ("times", "angles", "message"),
    [
        ([], [], "empty trajectory"),
        ([0, 0], [0, 0], "0 s again after 0 s"),
        ([0, -S], [0, 0], "goes back"),
        ([0], [0, 0], "1 times for 2 poses"),
        ([0, S], [0, 2.5], "143 degrees from the one before"),
    ],
)
def test_nonsense_is_refused(times, angles, message):
    with pytest.raises(TrajectoryError, match=message):
        Keyframes(times, [at(0, angle=a) for a in angles])


def test_velocities_must_fit():
    with pytest.raises(TrajectoryError, match="each keyframe"):
        Keyframes([0, S], [STILL, STILL], np.zeros((3, 3)))
