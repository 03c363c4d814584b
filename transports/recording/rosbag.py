"""ROS 1 bags and ROS 2 bags (folders with SQLite), written and read by rosbags: no ROS is needed.

Of `event_camera_msgs`, packets of the encodings "evt3" and "mono" are read, and "evt3" is written: each message
begins with its time and row, so that a reader may start anywhere. Its times are those of the camera; the stamp of its
header is Unix time. The times of `dvs_msgs` are Unix time themselves.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Bag1
from rosbags.rosbag2 import Writer as Bag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from firmware_protocol.events import EVENT, Events
from firmware_protocol.evt3.decoding import Evt3Decoder
from firmware_protocol.evt3.encoding import Evt3Encoder
from transports.recording.part import Facts, Part, RecordingError
from transports.recording.ros_messages import DVS_EVENT, EVENT_ARRAY, EVENT_PACKET, array_events, event_array

__all__ = ["BagReader", "Ros1DvsWriter", "Ros1Writer", "Ros2DvsWriter", "Ros2Writer"]

_PACKET, _ARRAY = "event_camera_msgs/msg/EventPacket", "dvs_msgs/msg/EventArray"
_DEFINITIONS = ((_PACKET, EVENT_PACKET), (_ARRAY, EVENT_ARRAY), ("dvs_msgs/msg/Event", DVS_EVENT))
_MOST_EVENTS = 1 << 15  # of a message
_ROS2_VERSION: Final = 8
_UNIX_US = 10**14  # the year 1973: cameras count from their start


def _typestore(store: Stores) -> Any:
    typestore = get_typestore(store)
    types: dict[str, Any] = {}
    for name, text in _DEFINITIONS:
        types |= get_types_from_msg(text.replace("time ts", "builtin_interfaces/Time ts"), name)
    typestore.register(types)
    return typestore


class _BagWriter:
    """Writes messages of one type to one topic."""

    _topic, _type = "/event_camera/events", _PACKET
    _store = Stores.ROS1_NOETIC

    def __init__(self, path: Path, facts: Facts) -> None:
        self._facts = facts
        self._size = facts.size or (0, 0)
        self._types = _typestore(self._store)
        self._encoder = Evt3Encoder(standalone=True, width=self._size[0])
        self._seq = 0
        self._stack = ExitStack()
        self._bag = self._stack.enter_context(self._opened(path))
        self._connection = self._bag.add_connection(self._topic, self._type, typestore=self._types)

    @property
    def _cdr(self) -> bool:
        return self._store is not Stores.ROS1_NOETIC

    def _opened(self, path: Path) -> Any:
        if self._cdr:
            return Bag2(path, version=_ROS2_VERSION)
        path.unlink(missing_ok=True)  # rosbags refuses a file that is there
        return Bag1(path)

    def write(self, part: Part) -> None:
        """Append messages of at most 32 768 events."""
        for start in range(0, max(len(part.events), 1), _MOST_EVENTS):
            piece = Part(part.events[start : start + _MOST_EVENTS], part.edges if not start else part.edges[:0])
            if len(piece.events) or len(piece.edges):
                self._put(piece)

    def _put(self, part: Part) -> None:
        first = min(int(t[0]) for t in (part.events["t"], part.edges["t"]) if len(t))
        stamp_us = self._facts.unix_us + first
        self._bag.write(self._connection, stamp_us * 1000, self._message(part, stamp_us))
        self._seq += 1

    def _message(self, part: Part, stamp_us: int) -> bytes:
        types = self._types.types
        stamp = types["builtin_interfaces/msg/Time"](sec=stamp_us // 1_000_000, nanosec=stamp_us % 1_000_000 * 1000)
        own = {} if self._cdr else {"seq": self._seq}
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera", **own)
        words = np.frombuffer(self._encoder.encode(part.events, part.edges), np.uint8)
        message = types[_PACKET](
            header=header, height=self._size[1], width=self._size[0], seq=self._seq, time_base=0, encoding="evt3",
            is_bigendian=False, events=words,
        )  # fmt: skip
        made = self._types.serialize_cdr if self._cdr else self._types.serialize_ros1
        return bytes(made(message, _PACKET))

    def close(self) -> None:
        """Write the index."""
        self._stack.close()


class Ros1Writer(_BagWriter):
    """Writes a ROS 1 bag of event_camera_msgs."""


class Ros2Writer(_BagWriter):
    """Writes a ROS 2 bag of event_camera_msgs."""

    _store = Stores.ROS2_HUMBLE


class Ros1DvsWriter(_BagWriter):
    """Writes a ROS 1 bag of dvs_msgs."""

    _topic, _type = "/dvs/events", _ARRAY

    def _message(self, part: Part, stamp_us: int) -> bytes:
        return event_array(part.events, self._size, self._facts.unix_us, self._seq, cdr=self._cdr)

    def write(self, part: Part) -> None:
        """Append messages of at most 32 768 events."""
        super().write(Part(part.events))


class Ros2DvsWriter(Ros1DvsWriter):
    """Writes a ROS 2 bag of dvs_msgs."""

    _store = Stores.ROS2_HUMBLE


class BagReader:
    """Reads the first topic with events of a ROS 1 bag or of a folder with a ROS 2 bag."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        self._bag = AnyReader([path], default_typestore=_typestore(Stores.ROS2_HUMBLE))
        self._bag.open()
        found = [c for c in self._bag.connections if c.msgtype in (_PACKET, _ARRAY)]
        if not found:
            raise RecordingError("it has no topic of event_camera_msgs/EventPacket or dvs_msgs/EventArray")
        self._topics = [c for c in found if c.topic == found[0].topic]
        self._is_array = found[0].msgtype == _ARRAY
        self._decoder = Evt3Decoder()
        self._start_us: int | None = None
        self._seen_size: tuple[int, int] | None = None
        next(self._parts(), None)  # of the first message: the size, and when it was
        self._decoder = Evt3Decoder()
        streams = frozenset[str]() if self._is_array else frozenset({"edges"})
        self.facts = Facts(self._seen_size or size, found[0].topic, self._start_us or 0, streams)

    def parts(self) -> Iterator[Part]:
        """Yield the events of each message."""
        yield from self._parts()
        self._bag.close()

    def _parts(self) -> Iterator[Part]:
        for connection, _, data in self._bag.messages(connections=self._topics):
            data = bytes(data)
            yield self._of_array(data) if self._is_array else self._of_packet(data, connection.msgtype)

    def _of_array(self, data: bytes) -> Part:
        try:
            events, self._seen_size = array_events(data, cdr=self._bag.is2)
        except ValueError as error:
            raise RecordingError(f"it is damaged: {error}") from error
        if self._start_us is None:  # Unix time is counted from the first event on; what is no such time stays as it is
            self._start_us = int(events["t"][0]) if len(events) and events["t"][0] > _UNIX_US else 0
        if self._start_us:
            events["t"] -= np.uint64(self._start_us)
        return Part(events)

    def _of_packet(self, data: bytes, kind: str) -> Part:
        message: Any = self._bag.deserialize(data, kind)
        self._seen_size = (message.width, message.height)
        words = message.events.tobytes()
        if message.encoding == "evt3":
            part = Part(*self._decoder.decode(words))
        elif message.encoding == "mono":
            part = Part(_mono(words, message.time_base))
        else:
            raise RecordingError(f'its events are encoded as "{message.encoding}"; "evt3" and "mono" are read')
        if self._start_us is None and len(part.events) and message.encoding == "evt3":
            stamp = message.header.stamp
            self._start_us = max(0, stamp.sec * 1_000_000 + stamp.nanosec // 1000 - int(part.events["t"][0]))
        return part


def _mono(data: bytes, base_ns: int) -> Events:
    words = np.frombuffer(data, "<u8", len(data) // 8)
    events = np.zeros(len(words), EVENT)
    events["t"] = (np.uint64(base_ns) + (words & np.uint64(0xFFFFFFFF))) // np.uint64(1000)
    events["x"] = (words >> np.uint64(32)) & np.uint64(0xFFFF)
    events["y"] = (words >> np.uint64(48)) & np.uint64(0x7FFF)
    events["on"] = words >> np.uint64(63) != 0
    return events
