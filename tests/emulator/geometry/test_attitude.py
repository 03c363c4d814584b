"""Rotations against scipy's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emulator.geometry.attitude import matrix_of, spin, unit


def test_quaternions_are_scalar_first():
    turn = Rotation.from_rotvec([0.3, -1.2, 0.5])
    x, y, z, w = turn.as_quat()
    np.testing.assert_allclose(matrix_of([3 * w, 3 * x, 3 * y, 3 * z]), turn.as_matrix(), atol=1e-15)


@pytest.mark.parametrize("pole", [(0, 0, 1), (0, 0, -1), (1e-9, 0, 1), (1, 0, 0), (0.3, -0.5, 0.8)])
def test_spin_is_a_rotation_about_the_pole(pole):
    pole = unit(pole)
    matrix = spin(pole, 0.37)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1)
    np.testing.assert_allclose(matrix @ [0, 0, 1], pole, atol=1e-12)
    tenth = Rotation.from_rotvec(0.2 * np.pi * pole).as_matrix()
    np.testing.assert_allclose(spin(pole, 0.47) @ matrix.T, tenth, atol=1e-12)
