"""Frames between spacecraft and flight computer on the CAN bus, 8 bytes each, little-endian, 11-bit identifiers.

    0x210  command    i16 east, i16 north, i16 up: acceleration without gravity's, mm/s2 | u16 turn that it answers
    0x211  attitude   i16 x, y, z: vector part of q_world_from_body in 1/32767, its w >= 0 | u16 number of its time
    0x212  edge       u16 counter of the SYNC | u48 time of its edge among the events, us (in real time alone)
    0x20f  estimate   as attitude: the flight computer's, for the attitude control | u16 number of its time
    0x213  range      u32 slant range, mm | u16 number of its time | u16 0
    0x214  star       as attitude: the star tracker's | u16 number of its time
    0x215  turn       i16 x, y, z: turn of the body in one period of the IMU, 1e-6 rad | u16 number of its end
    0x216  push       i16 x, y, z: its change of speed without gravity's, body, 1e-5 m/s | u16 number of its end

The SYNC of the bus (0x080) begins a turn; the camera sends the same instant as an edge among its events. Attitudes are
numbered by pictures in lockstep, by steps of the dynamics in real time. Numbers of the vehicle's own sensors, and of
the estimate, count periods of the IMU, 20 ms. With them no frame 0x211 is sent. An identifier decides on the bus who
sends first: a push comes after all frames of its time, and a command after its estimate.
"""

from __future__ import annotations

import math
import struct

import numpy as np
import numpy.typing as npt

__all__ = [
    "ATTITUDE",
    "COMMAND",
    "EDGE",
    "ESTIMATE",
    "PUSH",
    "PUSH_M_S",
    "RANGE",
    "STAR",
    "SYNC",
    "TURN",
    "TURN_RAD",
    "nearest_number",
    "pack_attitude",
    "pack_command",
    "pack_edge",
    "pack_range",
    "pack_vector",
    "unpack_attitude",
    "unpack_command",
    "unpack_edge",
    "unpack_range",
    "unpack_vector",
]

SYNC, COMMAND, ATTITUDE, EDGE = 0x080, 0x210, 0x211, 0x212
ESTIMATE, RANGE, STAR, TURN, PUSH = 0x20F, 0x213, 0x214, 0x215, 0x216
TURN_RAD, PUSH_M_S, _RANGE_M = 1e-6, 1e-5, 1e-3

_LAYOUT = struct.Struct("<hhhH")
_RANGE_LAYOUT = struct.Struct("<IHH")
_MM, _UNIT = 1000.0, 32767.0
_NUMBERS = 1 << 16


def pack_command(acceleration_m_s2: npt.NDArray[np.float64], turn: int) -> bytes:
    """Return the data of a command; accelerations beyond 32 m/s2 are clipped."""
    words = np.clip(np.round(acceleration_m_s2 * _MM), -_UNIT, _UNIT).astype(int)
    return _LAYOUT.pack(*words.tolist(), turn % _NUMBERS)


def unpack_command(data: bytes) -> tuple[npt.NDArray[np.float64], int]:
    """Return acceleration, m/s2, and turn; raises ValueError for other data."""
    *words, turn = _unpack(data)
    return np.array(words) / _MM, turn


def pack_attitude(q_world_from_body: npt.NDArray[np.float64], number: int) -> bytes:
    """Return the data of an attitude, a unit quaternion, scalar first."""
    vector = q_world_from_body[1:] * (1.0 if q_world_from_body[0] >= 0 else -1.0)
    return _LAYOUT.pack(*np.round(vector * _UNIT).astype(int).tolist(), number % _NUMBERS)


def unpack_attitude(data: bytes) -> tuple[npt.NDArray[np.float64], int]:
    """Return quaternion and number; raises ValueError for other data."""
    *words, number = _unpack(data)
    vector = np.array(words) / _UNIT
    return np.array([math.sqrt(max(0.0, 1 - float(vector @ vector))), *vector]), number


def pack_edge(counter: int, t_us: int) -> bytes:
    """Return the data with the time of a SYNC's edge."""
    return counter.to_bytes(2, "little") + t_us.to_bytes(6, "little")


def unpack_edge(data: bytes) -> tuple[int, int]:
    """Return counter and time, us; raises ValueError for other data."""
    if len(data) != _LAYOUT.size:
        raise ValueError(f"{len(data)} bytes: a frame of this bus has {_LAYOUT.size}")
    return int.from_bytes(data[:2], "little"), int.from_bytes(data[2:], "little")


def pack_vector(vector: npt.NDArray[np.float64], unit: float, number: int) -> bytes:
    """Return the data of a turn or a push in its unit; what is beyond 16 bits is clipped."""
    words = np.clip(np.round(vector / unit), -_UNIT, _UNIT).astype(int)
    return _LAYOUT.pack(*words.tolist(), number % _NUMBERS)


def unpack_vector(data: bytes, unit: float) -> tuple[npt.NDArray[np.float64], int]:
    """Return vector and number; raises ValueError for other data."""
    *words, number = _unpack(data)
    return np.array(words) * unit, number


def pack_range(range_m: float, number: int) -> bytes:
    """Return the data of a range."""
    return _RANGE_LAYOUT.pack(round(range_m / _RANGE_M), number % _NUMBERS, 0)


def unpack_range(data: bytes) -> tuple[float, int]:
    """Return range, m, and number; raises ValueError for other data."""
    if len(data) != _RANGE_LAYOUT.size:
        raise ValueError(f"{len(data)} bytes: a frame of this bus has {_RANGE_LAYOUT.size}")
    words, number, _ = _RANGE_LAYOUT.unpack(data)
    return words * _RANGE_M, number


def nearest_number(number: int, newest: int) -> int:
    """Return the full number of one that was sent modulo 65 536: the nearest to the newest known."""
    return number + _NUMBERS * round((newest - number) / _NUMBERS)


def _unpack(data: bytes) -> tuple[int, int, int, int]:
    if len(data) != _LAYOUT.size:
        raise ValueError(f"{len(data)} bytes: a frame of this bus has {_LAYOUT.size}")
    return _LAYOUT.unpack(data)
