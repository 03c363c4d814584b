"""The frames on the CAN bus between spacecraft and flight computer.

A frame has 8 bytes, little-endian, 11-bit identifiers.

    0x210  command    i16 east, i16 north, i16 up: acceleration without gravity's, mm/s2 | u16 turn that it answers
    0x211  attitude   i16 x, y, z: vector part of q_world_from_body in 1/32767, its w >= 0 | u16 number of its time
    0x212  edge       u16 counter of the SYNC | u48 time of its edge among the events, us (in real time alone)
    0x20f  estimate   as attitude: the flight computer's, for the attitude control | u16 number of its time
    0x213  range      u32 slant range, mm | u16 number of its time | u16 0
    0x214  star       as attitude: the star tracker's | u16 number of its time
    0x215  turn       i16 x, y, z: turn of the body in one period of the IMU, 1e-6 rad | u16 number of its end
    0x216  push       i16 x, y, z: its change of speed without gravity's, body, 1e-5 m/s | u16 number of its end

The SYNC of the bus (0x080) begins a turn; the camera sends the same instant as an edge among its events. Attitudes that
are given are numbered by light frames in lockstep, by steps of the dynamics in real time; other frames by periods of
the IMU, 20 ms. An identifier decides on the bus who sends first: a push comes after all frames of its time, and a
command after its estimate.
"""

from __future__ import annotations

import math
import struct

import numpy as np
from vehicle import Vector

SYNC, COMMAND, ATTITUDE, EDGE = 0x080, 0x210, 0x211, 0x212
ESTIMATE, RANGE, STAR, TURN, PUSH = 0x20F, 0x213, 0x214, 0x215, 0x216
TURN_RAD, PUSH_M_S, RANGE_M = 1e-6, 1e-5, 1e-3
"""Units of turn, push and range."""

RANGE_FRAME = struct.Struct("<IHxx")  # in RANGE_M

_WORDS, _EDGE = struct.Struct("<hhhH"), struct.Struct("<HIH")
_MM, _UNIT = 1000.0, 32767.0
_NUMBERS = 1 << 16


def pack_words(words: Vector, number: int) -> bytes:
    """Return the data of three words, (3,), in their unit, and a number; what is beyond 16 bits is clipped."""
    return _WORDS.pack(*np.clip(np.round(words), -_UNIT, _UNIT).astype(int).tolist(), number % _NUMBERS)


def unpack_words(data: bytes) -> tuple[Vector, int]:
    """Return words and number; raises struct.error for data of another length, as all that follow."""
    *words, number = _WORDS.unpack(data)
    return np.array(words), number


def pack_command(acceleration_m_s2: Vector, turn: int) -> bytes:
    """Return the data of a command; accelerations beyond 32 m/s2 are clipped."""
    return pack_words(acceleration_m_s2 * _MM, turn)


def unpack_command(data: bytes) -> tuple[Vector, int]:
    """Return acceleration, m/s2, and turn."""
    words, turn = unpack_words(data)
    return words / _MM, turn


def pack_attitude(q_world_from_body: Vector, number: int) -> bytes:
    """Return the data of an attitude, a unit quaternion, scalar first."""
    return pack_words(q_world_from_body[1:] * (1.0 if q_world_from_body[0] >= 0 else -1.0) * _UNIT, number)


def unpack_attitude(data: bytes) -> tuple[Vector, int]:
    """Return quaternion and number."""
    words, number = unpack_words(data)
    vector = words / _UNIT
    return np.array([math.sqrt(max(0.0, 1 - float(vector @ vector))), *vector]), number


def pack_edge(counter: int, t_us: int) -> bytes:
    """Return the data with the time of a SYNC's edge."""
    return _EDGE.pack(counter, t_us & 0xFFFF_FFFF, t_us >> 32)


def unpack_edge(data: bytes) -> tuple[int, int]:
    """Return counter and time, us."""
    counter, low, high = _EDGE.unpack(data)
    return counter, low | high << 32


def nearest_number(number: int, newest: int) -> int:
    """Return the full number of one that was sent modulo 65 536: the nearest to the newest known."""
    return number + _NUMBERS * round((newest - number) / _NUMBERS)
