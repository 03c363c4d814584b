"""Frames between spacecraft and flight computer on the CAN bus, 8 bytes each, little-endian, 11-bit identifiers.

    0x210  command    i16 east, i16 north, i16 up: acceleration without gravity's, mm/s2 | u16 turn that it answers
    0x211  attitude   i16 x, y, z: vector part of q_world_from_body in 1/32767, its w >= 0 | u16 number of its time
    0x212  edge       u16 counter of the SYNC | u48 time of its edge among the events, us (in real time alone)

The SYNC of the bus (0x080) begins a turn; the camera sends the same instant as an edge among its events. Attitudes are
numbered by pictures in lockstep, by steps of the dynamics in real time.
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
    "SYNC",
    "pack_attitude",
    "pack_command",
    "pack_edge",
    "unpack_attitude",
    "unpack_command",
    "unpack_edge",
]

SYNC, COMMAND, ATTITUDE, EDGE = 0x080, 0x210, 0x211, 0x212

_LAYOUT = struct.Struct("<hhhH")
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


def _unpack(data: bytes) -> tuple[int, int, int, int]:
    if len(data) != _LAYOUT.size:
        raise ValueError(f"{len(data)} bytes: a frame of this bus has {_LAYOUT.size}")
    return _LAYOUT.unpack(data)
