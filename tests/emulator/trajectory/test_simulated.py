"""Paths that a simulation flies."""

import numpy as np
import pytest

from emulator.trajectory.live import SimulatedPath
from emulator.trajectory.pose import STILL, Fixed, Pose, TrajectoryError

TURNED = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])  # 90 degrees about z


def at(x, q=STILL.q_world_from_body):
    return Pose(np.array([x, 0.0, 0.0]), q)


def test_without_a_pose_it_stays_at_the_rigs():
    assert SimulatedPath(Fixed(at(7.0))).pose(10**9).position_m[0] == 7.0


def test_before_the_second_pose_it_stays_at_the_first():
    path = SimulatedPath(Fixed(at(7.0)))
    path.add(0, at(1.0))
    assert [path.pose(t).position_m[0] for t in (-5, 0, 10**9)] == [1.0, 1.0, 1.0]


def test_between_and_after_poses_it_moves_on_a_line_and_a_great_circle():
    path = SimulatedPath(Fixed())
    for t_ns, x, q in ((0, 0.0, STILL.q_world_from_body), (100, 1.0, TURNED), (300, 5.0, TURNED)):
        path.add(t_ns, at(x, q))
    assert [path.pose(t).position_m[0] for t in (0, 50, 100, 200, 300, 400)] == pytest.approx([0, 0.5, 1, 3, 5, 7])
    assert path.pose(50).q_world_from_body == pytest.approx([np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)])


def test_old_poses_are_forgotten_and_the_newest_kept():
    path = SimulatedPath(Fixed())
    for k in range(1000):
        path.add(k * 10, at(float(k)))
    assert path.pose(9985).position_m[0] == pytest.approx(998.5)
    assert len(path.known) == 64


def test_time_does_not_go_back():
    path = SimulatedPath(Fixed())
    path.add(5, STILL)
    with pytest.raises(TrajectoryError, match="came after"):
        path.add(5, STILL)
