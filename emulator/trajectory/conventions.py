"""Attitudes in the conventions of other programs, turned into `q_world_from_camera`, scalar first, OpenCV camera axes.

    evstim, OpenCV     x right, y down, z out          (w, x, y, z), turns camera coordinates into the world's
    OpenGL             x right, y up, looks along -z
    ROS, scipy         (the camera frame 'optical' of ROS is OpenCV's)  (x, y, z, w)
    Basilisk, Vizard   image frame as OpenCV's         MRP sigma_CN: camera from inertial
    SPICE              each instrument's own axes      C-matrix: instrument from frame; NEAR's MSI looks along +X

For programs that write poses for evstim: tables (`.csv`), keyframes of a rig, or live poses (`firmware_protocol`).

    >>> from_basilisk([0.0, 0.0, 0.41421356]).round(3)
    array([0.707, 0.   , 0.   , 0.707])

Sources: Basilisk's CameraConfigMsg and Vizard pages; NAIF's Required Reading on rotations; Schaub and Junkins,
Analytical Mechanics of Space Systems, section 3.5 (MRP); REP 103 for ROS.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import Matrix, Quaternion, multiply

__all__ = [
    "CAMERA_FROM_MSI",
    "OPENGL_FROM_CAMERA",
    "from_basilisk",
    "from_opengl",
    "from_scalar_last",
    "from_spice",
]

CAMERA_FROM_MSI: Matrix = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""OpenCV axes from those of NEAR's camera, whose boresight is +X: right is +Y, down is +Z (kernel msi15.ti)."""

OPENGL_FROM_CAMERA: Quaternion = np.array([0.0, 1.0, 0.0, 0.0])
"""OpenGL's camera axes from OpenCV's: a half turn about x."""


def from_opengl(q_world_from_camera: npt.ArrayLike) -> Quaternion:
    """Return the attitude of a camera that looks along its -z with +y up; both quaternions are scalar first."""
    return _signed(multiply(np.asarray(q_world_from_camera, np.float64), OPENGL_FROM_CAMERA))


def from_scalar_last(q: npt.ArrayLike) -> Quaternion:
    """Return the same quaternion scalar first, as ROS and scipy write it scalar last."""
    return np.asarray(np.roll(np.asarray(q, np.float64), 1))


def from_basilisk(sigma_cn: npt.ArrayLike) -> Quaternion:
    """Return the attitude of Modified Rodrigues Parameters (3,), of the camera's frame from the inertial one."""
    from scipy.spatial.transform import (
        Rotation,  # loaded where it is used: it takes longer than the rest of a short run's imports
    )

    # An MRP set of `C from N` names the turn that takes N's axes into C's, which is world from camera.
    return _signed(Rotation.from_mrp(sigma_cn).as_quat(scalar_first=True))


def from_spice(instrument_from_frame: npt.ArrayLike, camera_from_instrument: npt.ArrayLike) -> Quaternion:
    """Return the attitude of a C-matrix (3, 3) and the instrument's axes (3, 3), such as CAMERA_FROM_MSI."""
    from scipy.spatial.transform import Rotation

    camera_from_world = np.asarray(camera_from_instrument) @ np.asarray(instrument_from_frame)
    return _signed(Rotation.from_matrix(camera_from_world).inv().as_quat(scalar_first=True))


def _signed(q: Quaternion) -> Quaternion:
    """Return the one of two equal quaternions with its scalar not below 0."""
    return np.asarray(-q if q[0] < 0 else q)
