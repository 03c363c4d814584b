"""ROS 1 bags and ROS 2 bags (folders with SQLite), written and read by rosbags: no ROS is needed.

Of `event_camera_msgs`, packets of the encodings "evt3" and "mono" are read, and "evt3" is written: each message
begins with its time and row, so that a reader may start anywhere. Its times are those of the camera; the stamp of its
header is Unix time. The times of `dvs_msgs` are Unix time themselves. Frames and samples of the inertial unit have
topics of their own beside that of the events; t = 0 is that of the camera, or the first sample where that is earlier.

A ROS 1 bag that was cut or not closed has no index: `_CutBag` finds the messages in the chunks that are there.

Messages of ROS with events: `event_camera_msgs/EventPacket`, and `dvs_msgs/EventArray` as bytes. That of
`prophesee_event_msgs` is the same.

An EventArray holds a record for each event, which rosbags would make of as many Python objects. Its bytes are made and
read here at once: 13 bytes an event in ROS 1. CDR (ROS 2) aligns times to 4 bytes, so that the first event takes 13
bytes, and each one after it 1 byte of padding, x, y, 2 bytes of padding, the time and the polarity.

Sources: ros-event-camera/event_camera_msgs, uzh-rpg/rpg_dvs_ros; OMG, "DDSI-RTPS", 10.2 (CDR).

Frames and samples of an inertial unit as messages of ROS: `sensor_msgs/Image` (mono8) and `sensor_msgs/Imu`.

An image is the whole array, 0 outside of the region that was read. Messages have no place for the end of an exposure
and for the temperature of the unit.

Source: REP 103 (units: m/s^2, rad/s), ros2/common_interfaces, sensor_msgs.
"""

from __future__ import annotations

import dataclasses
import math
import struct
import weakref
from bz2 import BZ2Decompressor
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from io import BytesIO
from pathlib import Path, PosixPath
from typing import Any, Final

import numpy as np
from lz4.frame import LZ4FrameDecompressor
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as IndexedBag
from rosbags.rosbag1 import ReaderError
from rosbags.rosbag1 import Writer as Bag1
from rosbags.rosbag1.reader import Chunk, Header, IndexData, RecordType, read_uint32
from rosbags.rosbag2 import Writer as Bag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from firmware_protocol.events import EVENT, Events, make_events
from firmware_protocol.evt.evt3 import Evt3Decoder, Evt3Encoder
from firmware_protocol.recordings.part import IMU, Facts, Frame, ImuRecords, Part, ten_bits
from transports.recording.part import DamagedRecording, RecordingError, Size

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
    for name in ("x", "y", "on"):
        records[name] = events[name]
    records["s"] = t_us // 1_000_000
    records["ns"] = t_us % 1_000_000 * 1000
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
    time_us = records["s"].astype(np.uint64) * np.uint64(1_000_000) + records["ns"] // np.uint32(1000)
    return make_events(time_us, records["x"], records["y"], records["on"] != 0)


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
    width, height = message.width, message.height
    step = message.step  # bytes from row to row
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


_PACKET, _ARRAY = "event_camera_msgs/msg/EventPacket", "dvs_msgs/msg/EventArray"
_ARRAYS = (_ARRAY, "prophesee_event_msgs/msg/EventArray")
_DEFINITIONS = ((_PACKET, EVENT_PACKET), (_ARRAY, EVENT_ARRAY), ("dvs_msgs/msg/Event", DVS_EVENT))
_KINDS = {"imu": SAMPLE, "frames": IMAGE}
_TOPICS = {"imu": "imu", "frames": "image_raw"}
_MOST_EVENTS = 1 << 15  # of a message
_ROS2_VERSION: Final = 8
_FOREVER_US = 1 << 62
_UNIX_US = 10**14  # the year 1973: cameras count from their start


def _typestore(store: Stores) -> Any:
    typestore = get_typestore(store)
    types: dict[str, Any] = {}
    for name, text in _DEFINITIONS:
        types |= get_types_from_msg(text.replace("time ts", "builtin_interfaces/Time ts"), name)
    typestore.register(types)
    return typestore


class _BagWriter:
    """Writes a topic of events, and topics of frames and IMU samples where the camera has them."""

    _space, _type = "/event_camera", _PACKET
    _store = Stores.ROS1_NOETIC

    def __init__(self, path: Path, facts: Facts) -> None:
        self._facts = facts
        self._size = facts.size or (0, 0)
        self._types = _typestore(self._store)
        self._encoder = Evt3Encoder(standalone=True, width=self._size[0])
        self._count: Counter[str] = Counter()
        self._stack = ExitStack()
        self._bag = self._stack.enter_context(self._opened(path))
        topics = {"events": self._type} | {
            _TOPICS[name]: kind for name, kind in _KINDS.items() if name in facts.streams
        }
        self._connections = {
            topic: self._bag.add_connection(f"{self._space}/{topic}", kind, typestore=self._types)
            for topic, kind in topics.items()
        }

    @property
    def _cdr(self) -> bool:
        return self._store is not Stores.ROS1_NOETIC

    def _opened(self, path: Path) -> Any:
        if self._cdr:
            return Bag2(path, version=_ROS2_VERSION)
        path.unlink(missing_ok=True)  # rosbags refuses a file that is there
        return Bag1(path)

    def write(self, part: Part) -> None:
        """Append messages, those of events with at most 32 768 of them."""
        for start in range(0, max(len(part.events), 1), _MOST_EVENTS):
            piece = Part(part.events[start : start + _MOST_EVENTS], part.edges if not start else part.edges[:0])
            if len(piece.events) or len(piece.edges):
                first = min(int(t[0]) for t in (piece.events["t"], piece.edges["t"]) if len(t))
                stamp_us = self._facts.unix_us + first
                self._put("events", stamp_us, self._message(piece, stamp_us))
        for sample in part.imu:
            stamp_us = self._facts.unix_us + int(sample["t"])
            message = sample_of(sample, self._header("imu", stamp_us), self._types.types)
            self._put("imu", stamp_us, self._serialized(message, SAMPLE))
        for frame in part.frames:
            stamp_us = max(0, self._facts.unix_us + frame.t_us)
            message = image_of(frame, self._size, self._header("image_raw", stamp_us), self._types.types)
            self._put("image_raw", stamp_us, self._serialized(message, IMAGE))

    def _put(self, topic: str, stamp_us: int, message: bytes) -> None:
        self._bag.write(self._connections[topic], stamp_us * 1000, message)
        self._count[topic] += 1

    def _header(self, topic: str, stamp_us: int) -> Any:
        types = self._types.types
        stamp = types["builtin_interfaces/msg/Time"](sec=stamp_us // 1_000_000, nanosec=stamp_us % 1_000_000 * 1000)
        number = {} if self._cdr else {"seq": self._count[topic]}  # which ROS 2 dropped
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera", **number)

    def _serialized(self, message: Any, kind: str) -> bytes:
        serialize = self._types.serialize_cdr if self._cdr else self._types.serialize_ros1
        return bytes(serialize(message, kind))

    def _message(self, part: Part, stamp_us: int) -> bytes:
        words = np.frombuffer(self._encoder.encode(part.events, part.edges), np.uint8)
        message = self._types.types[_PACKET](
            header=self._header("events", stamp_us), height=self._size[1], width=self._size[0],
            seq=self._count["events"], time_base=0, encoding="evt3", is_bigendian=False, events=words,
        )  # fmt: skip
        return self._serialized(message, _PACKET)

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

    _space, _type = "/dvs", _ARRAY

    def _message(self, part: Part, stamp_us: int) -> bytes:
        return event_array(part.events, self._size, self._facts.unix_us, self._count["events"], cdr=self._cdr)


class Ros2DvsWriter(Ros1DvsWriter):
    """Writes a ROS 2 bag of dvs_msgs."""

    _store = Stores.ROS2_HUMBLE


class _Bag1Path(PosixPath):
    """Path of a ROS 1 bag of any name, such as a.bag.active: rosbags goes by the suffix alone."""

    suffix = ".bag"


class _CutBag(IndexedBag):
    """Reader of a ROS 1 bag without a sound index, up to its first record that is damaged; `damage` names its place."""

    damage = "it is cut or was not closed: its index is missing, and every message before it is read"

    def open(self) -> None:
        """Find the connections and the messages in the chunks of the file."""
        self.bio = file = self.path.open("rb")
        size, at = self.path.stat().st_size, len(file.readline())
        connections, indexes = dict[int, Connection](), defaultdict[int, list[IndexData]](list)
        try:
            while at < size:
                header, length = Header.read(file), read_uint32(file)
                start = file.tell()
                missing = max(0, start + length - size)
                if header.get_uint8("op") == RecordType.CHUNK:
                    unpack = _UNPACK[header.get_string("compression")]
                    self.chunks[at] = Chunk(length - missing, start, unpack)
                    with suppress(*[ReaderError] if missing else ()):
                        self._find(BytesIO(unpack(file.read(length - missing))), at, connections, indexes)
                if missing:
                    raise ReaderError(f"its last {missing} octets are missing")
                at = file.seek(start + length)
        except (ReaderError, LookupError, OSError, ValueError, EOFError, RuntimeError, MemoryError) as error:
            self.damage = f"it is cut or damaged in its record at octet {at} of {size}: {error}"
        self.bio = file
        self.indexes = {number: sorted(indexes[number]) for number in connections}
        self.connections = [c._replace(msgcount=len(self.indexes[number])) for number, c in connections.items()]

    def _find(
        self, chunk: BytesIO, place: int, connections: dict[int, Connection], indexes: dict[int, list[IndexData]]
    ) -> None:
        """Add the connections and the messages of a chunk; raises ReaderError behind the last that is not cut."""
        self.bio, at = chunk, 0
        while at < len(chunk.getbuffer()):
            header, length = Header.read(chunk), read_uint32(chunk)
            end, kind = chunk.tell() + length, header.get_uint8("op")
            if end > len(chunk.getbuffer()):
                raise ReaderError("a record in it is cut")
            if kind == RecordType.CONNECTION:
                chunk.seek(at)
                connection = self.read_connection()
                connections.setdefault(connection.id, connection)
            elif kind == RecordType.MSGDATA:
                indexes[header.get_uint32("conn")].append(IndexData(header.get_time("time"), place, at))
            at = chunk.seek(end)


_UNPACK: dict[str, Callable[[bytes], bytes]] = {
    "none": bytes,
    "bz2": lambda data: BZ2Decompressor().decompress(data),
    "lz4": lambda data: LZ4FrameDecompressor().decompress(data),
}
"""Decompressors of a chunk, or of its first octets, by the name of its compression."""


class BagReader:
    """Reads a topic with events of a ROS 1 bag or of a folder with a ROS 2 bag, and the frames and samples beside it.

    Without `topic` the first one is read. Of frames and samples the first topics in its name space are read.
    """

    def __init__(self, path: Path, size: Size | None, topic: str = "") -> None:
        named = path if path.is_dir() else _Bag1Path(path)
        self._bag = AnyReader([named], default_typestore=_typestore(Stores.ROS2_HUMBLE))
        self._damage = ""
        try:
            self._bag.open()
        except Exception:  # rosbags raises errors of any type for an index that is cut
            if self._bag.is2:
                raise
            bag = _CutBag(path)
            self._bag.readers = [bag]
            self._bag.open()
            self._damage = bag.damage
        weakref.finalize(self, self._bag.close)  # also where it is left before its end
        counts: Counter[str] = Counter()
        for connection in self._bag.connections:
            if connection.msgtype in (_PACKET, *_ARRAYS):
                counts[connection.topic] += connection.msgcount
        if not counts:
            lacking = "it has no topic of event_camera_msgs/EventPacket or dvs_msgs/EventArray"
            if self._damage:
                raise DamagedRecording(f"{self._damage}; before that {lacking}")
            raise RecordingError(lacking)
        if topic and topic not in counts:
            raise RecordingError(f"it has no events of the topic {topic}, but of {', '.join(counts)}")
        topic = topic or next(iter(counts))
        beside = {name: other for name, kind in _KINDS.items() if (other := self._beside(topic, kind))}
        self._connections = [c for c in self._bag.connections if c.topic in {topic, *beside.values()}]
        self._is_array = any(c.topic == topic and c.msgtype in _ARRAYS for c in self._connections)
        self._seen_size: Size | None = None
        self._decoder = Evt3Decoder()
        self._zero_us, self._start_us = self._first_us()
        self._decoder = Evt3Decoder()
        streams = frozenset(beside) if self._is_array else frozenset({"edges", *beside})
        self.facts = Facts(self._seen_size or size, topic, self._start_us, streams, topics=dict(counts))

    def _beside(self, topic: str, kind: str) -> str | None:
        """Return the first topic of a type in the name space of another one: elsewhere it is of another camera."""
        topics = [c.topic for c in self._bag.connections if c.msgtype == kind]
        name_space = topic.rpartition("/")[0]
        return next((candidate for candidate in topics if candidate.rpartition("/")[0] == name_space), None)

    def _first_us(self) -> tuple[int, int]:
        """Return the Unix times of an event of time 0 and of t = 0, us, or 0, by the messages up to the first events.

        They differ where samples are earlier than the camera's zero: all times count from the first one then.
        """
        earliest_us = sample_us = _FOREVER_US
        for part, stamp_us in self._stamped():
            times = [int(t[0]) for t in (part.events["t"], part.edges["t"]) if len(t)]
            sample_us = min(sample_us, stamp_us) if len(part.imu) else sample_us
            if self._is_array:  # Unix time counts from the first message on
                earliest_us = min([earliest_us, *(times or [stamp_us])])
                if times:
                    return 0, earliest_us if earliest_us > _UNIX_US else 0
            elif times:
                zero_us = max(0, stamp_us - min(times)) if stamp_us else 0
                return zero_us, min(zero_us, sample_us)
        return 0, 0

    def parts(self) -> Iterator[Part]:
        """Yield what each message holds."""
        start_us, early = self._start_us, 0
        later_us = self._zero_us - start_us
        for part, _ in self._stamped():
            sound = int(np.append(part.events["t"] < np.uint64(max(0, -later_us)), True).argmax())
            events, imu = part.events[:sound], part.imu[part.imu["t"] >= start_us]
            for records, by_us in ((events, later_us), (part.edges, later_us), (imu, -start_us)):
                records["t"] += np.int64(by_us).view(np.uint64)
            early += len(part.imu) - len(imu)
            yield Part(events, part.edges, imu, tuple(_later(frame, -start_us) for frame in part.frames))
            if sound < len(part.events):
                time_us = part.events["t"][sound]
                raise RecordingError(f"it is damaged: an event at {time_us} us is before its first message")
        if self._damage:
            raise RecordingError(self._damage)
        if early:
            raise RecordingError(f"{early} samples of its inertial unit are before its first events, and are left out")

    def _stamped(self) -> Iterator[tuple[Part, int]]:
        """Yield what each message holds, and its stamp, us: frames and samples in Unix time, events as they are."""
        for connection, _, raw in self._bag.messages(connections=self._connections):
            data = bytes(raw)
            if connection.msgtype in _ARRAYS:
                yield self._of_array(data), 0
                continue
            message: Any = self._bag.deserialize(data, connection.msgtype)
            stamp_us = message.header.stamp.sec * 1_000_000 + message.header.stamp.nanosec // 1000
            if connection.msgtype == _PACKET:
                yield self._of_packet(message), stamp_us if message.encoding == "evt3" else 0
            elif connection.msgtype == SAMPLE:
                yield Part(imu=imu_of(message, stamp_us)), stamp_us
            elif (frame := frame_of(message, stamp_us)) is not None:
                yield Part(frames=(frame,)), stamp_us

    def _of_array(self, data: bytes) -> Part:
        try:
            events, size = array_events(data, cdr=self._bag.is2)
        except ValueError as error:
            raise RecordingError(f"it is damaged: {error}") from error
        self._seen_size = size if all(size) else None
        return Part(events)

    def _of_packet(self, message: Any) -> Part:
        self._seen_size = (message.width, message.height) if message.width and message.height else None
        words = message.events.tobytes()
        if message.encoding == "evt3":
            return Part(*self._decoder.decode(words))
        if message.encoding == "mono":
            return Part(_mono(words, message.time_base))
        raise RecordingError(f'its events are encoded as "{message.encoding}"; "evt3" and "mono" are read')


def _later(frame: Frame, by_us: int) -> Frame:
    times = ("t_us", "exposure_begin_us", "exposure_end_us")
    return dataclasses.replace(frame, **{name: getattr(frame, name) + by_us for name in times})


def _mono(data: bytes, base_ns: int) -> Events:
    words = np.frombuffer(data, "<u8", len(data) // 8)
    time_us = (np.uint64(base_ns) + (words & np.uint64(0xFFFFFFFF))) // np.uint64(1000)
    x = (words >> np.uint64(32)) & np.uint64(0xFFFF)
    y = (words >> np.uint64(48)) & np.uint64(0x7FFF)
    return make_events(time_us, x, y, words >> np.uint64(63) != 0)
