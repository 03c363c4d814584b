"""Frames and samples of an inertial unit as messages of ROS: `sensor_msgs/Image` (mono8) and `sensor_msgs/Imu`.

An image is the whole array, 0 outside of the region that was read. Messages have no place for the end of an exposure
and for the temperature of the unit.

Source: REP 103 (units: m/s^2, rad/s), ros2/common_interfaces, sensor_msgs.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from firmware_protocol.recordings.part import IMU, Frame, ImuRecords, ten_bits

__all__ = ["IMAGE", "SAMPLE", "frame_of", "image_of", "imu_of", "sample_of"]

IMAGE, SAMPLE = "sensor_msgs/msg/Image", "sensor_msgs/msg/Imu"
_G, _DEGREE = 9.80665, math.pi / 180
_BITS = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2"}


def image_of(frame: Frame, size: tuple[int, int], header: Any, types: Any) -> Any:
    """Return the message of a frame of a sensor of `size` = (width, height)."""
    array = np.zeros(size[::-1], np.uint8)
    (column, row), (rows, columns) = frame.origin, frame.pixels.shape[:2]
    array[row : row + rows, column : column + columns] = ten_bits(frame) >> 2
    return types[IMAGE](
        header=header, height=size[1], width=size[0], encoding="mono8", is_bigendian=0, step=size[0], data=array.ravel()
    )


def frame_of(message: Any, t_us: int) -> Frame | None:
    """Return the frame of a message, without an exposure; None where it is not grey or larger than its data."""
    bits = _BITS.get(message.encoding)
    if bits is None:
        return None
    dtype = np.dtype((">" if message.is_bigendian else "<") + bits)
    width, height, step = message.width, message.height, message.step
    data = np.ascontiguousarray(message.data, np.uint8)
    if min(width, height) < 1 or step < width * dtype.itemsize or len(data) < step * height:
        return None
    rows = data[: step * height].reshape(height, step)[:, : width * dtype.itemsize]
    pixels = np.ascontiguousarray(rows).view(dtype).astype(dtype.newbyteorder("="))
    return Frame(t_us, t_us, t_us, pixels)


def sample_of(sample: np.void, header: Any, types: Any) -> Any:
    """Return the message of a sample, a record of IMU; it has no orientation."""
    vector, none = types["geometry_msgs/msg/Vector3"], np.zeros(9)
    return types[SAMPLE](
        header=header,
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.array([-1.0, *none[1:]]),
        angular_velocity=vector(**{axis: float(sample[f"gyroscope_{axis}"]) * _DEGREE for axis in "xyz"}),
        angular_velocity_covariance=none,
        linear_acceleration=vector(**{axis: float(sample[f"accelerometer_{axis}"]) * _G for axis in "xyz"}),
        linear_acceleration_covariance=none,
    )


def imu_of(message: Any, t_us: int) -> ImuRecords:
    """Return the sample of a message, (1,) IMU, of an unknown temperature, 0."""
    imu = np.zeros(1, IMU)
    imu["t"] = t_us
    for axis in "xyz":
        imu[f"accelerometer_{axis}"] = getattr(message.linear_acceleration, axis) / _G
        imu[f"gyroscope_{axis}"] = getattr(message.angular_velocity, axis) / _DEGREE
    return imu
