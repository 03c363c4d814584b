"""Poses are composed and inverted as matrices are, and refuse what is no attitude."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from emulator.geometry.attitude import multiply
from emulator.trajectory.pose import STILL, Pose

numbers = st.floats(-1, 1)
quaternions = st.tuples(numbers, numbers, numbers, numbers).filter(lambda q: np.linalg.norm(q) > 0.1)
places = st.tuples(*[st.floats(-1e6, 1e6)] * 3)
poses = st.builds(lambda p, q: Pose(np.array(p), np.array(q) / np.linalg.norm(q)), places, quaternions)


@given(poses)
def test_a_pose_turns_as_scipy_does(pose):
    oracle = Rotation.from_quat(pose.q_world_from_body, scalar_first=True).as_matrix()
    np.testing.assert_allclose(pose.world_from_body, oracle, atol=1e-12)


@given(poses, poses, places)
def test_a_child_s_point_goes_through_both_poses(parent, child, point):
    in_parent = child.world_from_body @ point + child.position_m
    expected = parent.world_from_body @ in_parent + parent.position_m
    both = parent.after(child)
    np.testing.assert_allclose(both.world_from_body @ point + both.position_m, expected, atol=1e-6)


@given(poses)
def test_a_pose_after_its_inverse_is_still(pose):
    both = pose.inverse().after(pose)
    np.testing.assert_allclose(both.position_m, STILL.position_m, atol=1e-6)
    np.testing.assert_allclose(both.world_from_body, np.eye(3), atol=1e-12)


def test_the_second_turn_is_written_first():
    quarter_about_z, quarter_about_x = np.array([1, 0, 0, 1]) / 2**0.5, np.array([1, 1, 0, 0]) / 2**0.5
    both = Pose(np.zeros(3), multiply(quarter_about_x, quarter_about_z)).world_from_body
    np.testing.assert_allclose(both @ [1, 0, 0], [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("q", "says"),
    [
        ((2, 0, 0, 0), "of length 2$"),
        ((1, 2, 3, 4), "of length 5.477$"),
        ((1e200, 0, 0, 0), "of length 1e\\+200$"),
        ((0, 0, 0, 0), "of length 0$"),
        ((np.nan, 0, 0, 1), "1\\.\\]$"),
        ((1.7e308, 1.7e308, 0, 1), "\\]$"),
        ((np.inf, 0, 0, 1), "1\\.\\]$"),
        ((1, 0, 0), "got \\[1. 0. 0.\\]$"),
        (np.eye(3), r"from_matrix\(matrix\).as_quat\(scalar_first=True\)"),
    ],
)
def test_what_is_no_unit_quaternion_is_refused(q, says):
    with pytest.raises(ValueError, match=r"unit quaternion \(w, x, y, z\), got") as refusal:
        Pose(np.zeros(3), np.array(q, float))
    assert re.search(says, str(refusal.value))


def test_a_place_must_be_finite():
    with pytest.raises(ValueError, match="three finite metres"):
        Pose(np.array([np.inf, 0, 0]), STILL.q_world_from_body)
