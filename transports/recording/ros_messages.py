"""Messages of ROS with events: `event_camera_msgs/EventPacket`, and `dvs_msgs/EventArray` as bytes.

An EventArray holds a record for each event, which rosbags would make of as many Python objects. Its bytes are made and
read here at once: 13 bytes an event in ROS 1. CDR (ROS 2) aligns times to 4 bytes, so that the first event takes 13
bytes, and each one after it 1 byte of padding, x, y, 2 bytes of padding, the time and the polarity.

Sources: ros-event-camera/event_camera_msgs, uzh-rpg/rpg_dvs_ros; OMG, "DDSI-RTPS", 10.2 (CDR).
"""

from __future__ import annotations

import struct

import numpy as np

from firmware_protocol.events import EVENT, Events

__all__ = ["DVS_EVENT", "EVENT_ARRAY", "EVENT_PACKET", "array_events", "event_array"]

_HEADER = "std_msgs/Header header\nuint32 height\nuint32 width\n"
EVENT_PACKET = f"{_HEADER}uint64 seq\nuint64 time_base\nstring encoding\nbool is_bigendian\nuint8[] events\n"
"""Definition of event_camera_msgs/msg/EventPacket."""
EVENT_ARRAY = f"{_HEADER}dvs_msgs/Event[] events\n"
"""Definition of dvs_msgs/msg/EventArray."""
DVS_EVENT = "uint16 x\nuint16 y\ntime ts\nbool polarity\n"
"""Definition of dvs_msgs/msg/Event."""

_PACKED = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("on", "u1")])
_ALIGNED = np.dtype(
    {
        "names": ["x", "y", "s", "ns", "on"],
        "formats": ["<u2", "<u2", "<u4", "<u4", "u1"],
        "offsets": [1, 3, 7, 11, 15],
        "itemsize": 16,
    }
)
_CDR = b"\0\1\0\0"  # little-endian


def event_array(events: Events, size: tuple[int, int], unix_us: int, seq: int, *, cdr: bool) -> bytes:
    """Return a message of events (n > 0,) EVENT at `unix_us` + t, for ROS 2 (`cdr`) or ROS 1."""
    t_us = events["t"].astype(np.int64) + unix_us
    stamp = divmod(int(t_us[0]), 1_000_000)
    head = struct.pack("<II", stamp[0], stamp[1] * 1000)
    frame = struct.pack("<I6s", 6, b"camera")
    if not cdr:
        body = _filled(np.zeros(len(events), _PACKED), events, t_us).tobytes()
        return struct.pack("<I", seq) + head + frame + struct.pack("<III", size[1], size[0], len(events)) + body
    named = struct.pack("<I7sx", 7, b"camera\0")
    aligned = _filled(np.zeros(len(events), _ALIGNED), events, t_us).tobytes()
    first = aligned[1:5] + aligned[7:16]
    return _CDR + head + named + struct.pack("<III", size[1], size[0], len(events)) + first + aligned[16:]


def _filled(records: np.ndarray, events: Events, t_us: np.ndarray) -> np.ndarray:
    records["x"], records["y"], records["on"] = events["x"], events["y"], events["on"]
    records["s"], records["ns"] = t_us // 1_000_000, t_us % 1_000_000 * 1000
    return records


def array_events(message: bytes, *, cdr: bool) -> tuple[Events, tuple[int, int]]:
    """Return the events (n,) EVENT of a message, in Unix time, us, and (width, height); raises ValueError."""
    try:
        return _cdr_events(message) if cdr else _ros1_events(message)
    except struct.error as error:
        raise ValueError("a message of events is cut") from error


def _ros1_events(message: bytes) -> tuple[Events, tuple[int, int]]:
    (name,) = struct.unpack_from("<12xI", message)
    height, width, count = struct.unpack_from("<III", message, 16 + name)
    start = 28 + name
    if count * _PACKED.itemsize > len(message) - start:
        raise ValueError("a message of events is cut")
    return _events(np.frombuffer(message, _PACKED, count, start)), (width, height)


def _cdr_events(message: bytes) -> tuple[Events, tuple[int, int]]:
    if message[1:2] != b"\1":
        raise ValueError("a message of events is big-endian")
    (name,) = struct.unpack_from("<12xI", message)
    at = 16 + -(-name // 4) * 4
    height, width, count = struct.unpack_from("<III", message, at)
    body = message[at + 12 :]
    if not count:
        return np.zeros(0, EVENT), (width, height)
    if 16 * count - 3 > len(body):
        raise ValueError("a message of events is cut")
    padded = b"\0" + body[:4] + b"\0\0" + body[4 : 16 * count - 3]
    return _events(np.frombuffer(padded, _ALIGNED, count)), (width, height)


def _events(records: np.ndarray) -> Events:
    events = np.zeros(len(records), EVENT)
    events["x"], events["y"], events["on"] = records["x"], records["y"], records["on"] != 0
    events["t"] = records["s"].astype(np.uint64) * np.uint64(1_000_000) + records["ns"] // np.uint32(1000)
    return events
