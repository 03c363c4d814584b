"""How others write attitudes, turned into ours: OpenCV camera axes and scalar-first `q_world_from_camera`.

    ours, OpenCV       x right, y down, z out          (w, x, y, z), turns camera coordinates into the world's
    OpenGL             x right, y up, looks along -z
    ROS, scipy         (their camera frame 'optical' is OpenCV's)      (x, y, z, w)
    Basilisk, Vizard   image frame as OpenCV's         MRP sigma_CN: camera from inertial
    SPICE              each instrument's own axes      C-matrix: instrument from frame; NEAR's MSI looks along +X

Sources: Basilisk's CameraConfigMsg and Vizard pages; NAIF's Required Reading on rotations; Schaub and Junkins,
Analytical Mechanics of Space Systems, section 3.5 (MRP); REP 103 for ROS.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import Matrix, quaternion_of

__all__ = ["CAMERA_FROM_MSI", "from_basilisk", "from_opengl", "from_scalar_last", "from_spice"]

_Quaternion = npt.NDArray[np.float64]


CAMERA_FROM_MSI: Matrix = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""OpenCV axes from those of NEAR's camera, whose boresight is +X: right is +Y, down is +Z (kernel msi15.ti)."""


def from_opengl(q_world_from_camera: npt.ArrayLike) -> _Quaternion:
    """Return ours of a camera that looks along its -z with +y up; the quaternion is scalar first."""
    w, x, y, z = np.asarray(q_world_from_camera, np.float64)
    # A half turn about x, (0, 1, 0, 0), on the right.
    return _signed(np.array([-x, w, z, -y]))


def from_scalar_last(q: npt.ArrayLike) -> _Quaternion:
    """Return the same turn scalar first."""
    return np.asarray(np.roll(np.asarray(q, np.float64), 1))


def from_basilisk(sigma_cn: npt.ArrayLike) -> _Quaternion:
    """Return world_from_camera of Modified Rodrigues Parameters (3,) of the camera's frame from the inertial one."""
    sigma = np.asarray(sigma_cn, np.float64)
    square = float(sigma @ sigma)
    scalar, vector = (1 - square) / (1 + square), 2 * sigma / (1 + square)
    # An MRP set of `C from N` names the turn that takes N's axes into C's, which is also our world_from_camera.
    return _signed(np.concatenate([[scalar], vector]))


def from_spice(instrument_from_frame: npt.ArrayLike, camera_from_instrument: npt.ArrayLike) -> _Quaternion:
    """Return ours of a C-matrix (3, 3) and the instrument's axes, such as CAMERA_FROM_MSI."""
    camera_from_world = np.asarray(camera_from_instrument) @ np.asarray(instrument_from_frame)
    return quaternion_of(camera_from_world.T)


def _signed(q: _Quaternion) -> _Quaternion:
    """Return the one of two equal quaternions with its scalar not below 0."""
    return -q if q[0] < 0 else q
