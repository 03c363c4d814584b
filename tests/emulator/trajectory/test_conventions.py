"""Other people's attitudes: each is checked by where a known direction lands, not by a formula."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from emulator.geometry.attitude import matrix_of
from emulator.trajectory.pose import CAMERA_FROM_MSI, from_basilisk, from_opengl, from_scalar_last, from_spice

TURN = Rotation.from_euler("ZYX", [0.3, -0.7, 1.1])


def test_an_opengl_camera_looks_along_its_minus_z():
    q = from_opengl(TURN.as_quat(scalar_first=True))
    np.testing.assert_allclose(matrix_of(q) @ [0, 0, 1], TURN.apply([0, 0, -1]), atol=1e-12)
    np.testing.assert_allclose(matrix_of(q) @ [0, -1, 0], TURN.apply([0, 1, 0]), atol=1e-12)
    np.testing.assert_allclose(matrix_of(q) @ [1, 0, 0], TURN.apply([1, 0, 0]), atol=1e-12)


def test_scalar_last():
    np.testing.assert_allclose(from_scalar_last(TURN.as_quat()), TURN.as_quat(scalar_first=True))


def test_basilisk_s_parameters_take_the_inertial_axes_into_the_camera_s():
    """Schaub and Junkins: [CN] = I + (8 S^2 - 4 (1 - s^2) S) / (1 + s^2)^2 with S the cross-product matrix."""
    sigma = np.array([0.1, -0.3, 0.2])
    cross = np.array([[0, -sigma[2], sigma[1]], [sigma[2], 0, -sigma[0]], [-sigma[1], sigma[0], 0]])
    square = sigma @ sigma
    camera_from_inertial = np.eye(3) + (8 * cross @ cross - 4 * (1 - square) * cross) / (1 + square) ** 2
    np.testing.assert_allclose(matrix_of(from_basilisk(sigma)).T, camera_from_inertial, atol=1e-12)


def test_a_spice_instrument_that_looks_along_its_x():
    instrument_from_frame = TURN.as_matrix()
    q = from_spice(instrument_from_frame, CAMERA_FROM_MSI)
    np.testing.assert_allclose(matrix_of(q) @ [0, 0, 1], instrument_from_frame.T @ [1, 0, 0], atol=1e-12)
    assert np.linalg.det(CAMERA_FROM_MSI) == pytest.approx(1.0)
