"""Messages of ROS 2: `event_camera_msgs/EventPacket` is written, `sensor_msgs/Image` written and read.

    both          i32 s   u32 ns   frame_id                               std_msgs/Header: Unix time of the first event
    EventPacket   u32 height   u32 width   u64 seq   u64 time_base, ns   encoding   u8 is_bigendian   u8[] events
    Image         u32 height   u32 width   encoding   u8 is_bigendian   u32 step   u8[] data

The events of the encoding "evt3" are Prophesee's words of 16 bits, whose times are the camera's own. Those of "mono"
are words of 64 bits: 32 of time, ns after `time_base`; 16 of x, 15 of y; polarity.

ROS 2 gives each type a hash over its definition (RIHS01), which a writer sends in its user data: `ros2 topic info -v`
shows it, and ROS warns if reader and writer differ.

Sources: ros-event-camera/event_camera_msgs, message and codecs; ros2/common_interfaces, sensor_msgs; REP 2011 for the
hashes (computed by rosbags 0.11).

CDR, the encoding of messages of ROS 2: little-endian, each number at a multiple of its own size.

    0 1 0 0     plain CDR, little-endian; the offsets of all that follows are counted from here
    string      u32 length with its final zero, text, zero
    sequence    u32 number of elements, elements

Source: OMG, "DDS Interoperability Wire Protocol" (DDSI-RTPS) 2.3, section 10; "Extended CDR", encoding version 1.

`levels_of` returns the levels of an image by its encoding:

    mono8 8UC1           a level each                 mono16 16UC1   likewise, 16 bits in the message's byte order
    rgb8 8UC3 rgba8      luminance of three levels    bgr8 bgra8     the same, in reverse order
    32FC1                linear light

Source: ros2/common_interfaces, sensor_msgs/image_encodings.hpp; luminance of Rec. 709.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Events

Octets = bytes | bytearray | memoryview

_LITTLE, _BIG = b"\0\1", b"\0\0"
_HEAD_BYTES = 4


class CdrError(ValueError):
    """A message does not fit its type."""


class CdrWriter:
    """Writes one message."""

    def __init__(self) -> None:
        self._data = bytearray(_LITTLE + b"\0\0")

    def number(self, form: str, value: int) -> None:
        """Append a number of the `struct` format `form`."""
        size = struct.calcsize(form)
        self._align(size)
        self._data += struct.pack("<" + form, value)

    def text(self, text: str) -> None:
        """Append a string."""
        encoded = text.encode() + b"\0"
        self.number("I", len(encoded))
        self._data += encoded

    def octets(self, data: Octets) -> None:
        """Append a sequence of octets."""
        view = memoryview(data).cast("B")
        self.number("I", len(view))
        self._data += view

    def message(self) -> bytes:
        """Return the message, padded to a multiple of four bytes."""
        self._align(4)
        return bytes(self._data)

    def _align(self, size: int) -> None:
        self._data += bytes(-(len(self._data) - _HEAD_BYTES) % size)


class CdrReader:
    """Reads one message, of either byte order; raises CdrError for missing data."""

    def __init__(self, message: bytes) -> None:
        if message[:2] not in (_LITTLE, _BIG) or len(message) < _HEAD_BYTES:
            raise CdrError("a message is not plain CDR")
        self._order = "<" if message[:2] == _LITTLE else ">"
        self._data = memoryview(message)[_HEAD_BYTES:]
        self._at = 0

    def number(self, form: str) -> int:
        """Return the next number, of the `struct` format `form`."""
        size = struct.calcsize(form)
        self._at += -self._at % size
        value = struct.unpack(self._order + form, self._taken(size))[0]
        return int(value)

    def text(self) -> str:
        """Return the next string."""
        encoded = bytes(self._taken(self.number("I")))
        if encoded[-1:] != b"\0":
            raise CdrError("a string has no end")
        return encoded[:-1].decode(errors="replace")

    def octets(self) -> memoryview:
        """Return the next sequence of octets, a part of the message."""
        return self._taken(self.number("I"))

    def _taken(self, size: int) -> memoryview:
        if size > len(self._data) - self._at:
            raise CdrError("a message is cut")
        self._at += size
        return self._data[self._at - size : self._at]


_S_NS = 1_000_000_000
_MOST_MONO_NS = (1 << 32) - 1


@dataclass(frozen=True)
class MessageType:
    """A type of messages: `ros`, its name in ROS, "package/msg/Name"; `rihs01`, hash of its definition, hexadecimal."""

    ros: str
    rihs01: str


EVENT_PACKET = MessageType(
    "event_camera_msgs/msg/EventPacket", "d6fa176260b1f37e5a40845305315e150a0f18191241eb64f407442aa29844aa"
)
IMAGE = MessageType("sensor_msgs/msg/Image", "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47")


@dataclass(frozen=True)
class Header:
    """Time and source: Unix time, ns, and the name of the camera's frame."""

    stamp_ns: int
    frame_id: str


@dataclass(frozen=True, eq=False)
class Image:
    """An image.

    Attributes
    ----------
    size : (width, height), pixels.
    encoding : "rgb8", "mono16", ...
    step : bytes of a row.
    """

    header: Header
    size: tuple[int, int]
    encoding: str
    step: int
    data: Octets
    is_bigendian: bool = False


def event_packet(header: Header, size: tuple[int, int], seq: int, encoding: str, events: bytes, base_ns: int) -> bytes:
    """Return a message of events coded in `encoding`, of a sensor of `size` = (width, height)."""
    message = _begun(header, size)
    message.number("Q", seq)
    message.number("Q", base_ns)
    message.text(encoding)
    message.number("B", 0)
    message.octets(events)
    return message.message()


def mono_events(events: Events) -> tuple[bytes, int]:
    """Return the words of events (n > 0,) EVENT and their time base, ns; raises ValueError for more than 4.2 s."""
    t_ns = events["t"].astype(np.int64) * 1000
    since = t_ns - t_ns[0]
    if since[-1] > _MOST_MONO_NS:
        raise ValueError("a message of mono events holds 4.29 s at most")
    words = since.astype(np.uint64)
    words |= events["x"].astype(np.uint64) << np.uint64(32)
    words |= events["y"].astype(np.uint64) << np.uint64(48)
    words |= events["on"].astype(np.uint64) << np.uint64(63)
    return words.astype("<u8").tobytes(), int(t_ns[0])


def image_message(image: Image) -> bytes:
    """Return the message of an image."""
    message = _begun(image.header, image.size)
    message.text(image.encoding)
    message.number("B", image.is_bigendian)
    message.number("I", image.step)
    message.octets(image.data)
    return message.message()


def parse_image(message: bytes) -> Image:
    """Return the image in a message, its data not copied and not checked; raises CdrError."""
    reader = CdrReader(message)
    stamp_ns = reader.number("i") * _S_NS + reader.number("I")
    header = Header(stamp_ns, reader.text())
    height, width = reader.number("I"), reader.number("I")
    encoding = reader.text()
    is_bigendian, step = reader.number("B") != 0, reader.number("I")
    return Image(header, (width, height), encoding, step, reader.octets(), is_bigendian)


def _begun(header: Header, size: tuple[int, int]) -> CdrWriter:
    message = CdrWriter()
    seconds, ns = divmod(header.stamp_ns, _S_NS)
    message.number("i", seconds)
    message.number("I", ns)
    message.text(header.frame_id)
    message.number("I", size[1])
    message.number("I", size[0])
    return message


Levels = npt.NDArray[Any]

_MOST_PX = 1 << 23
_RGB = np.array([0.2126, 0.7152, 0.0722], np.float32)
# name: type of a number, numbers of a pixel, true if blue comes first
ENCODINGS = {
    "mono8": ("u1", 1, False), "8UC1": ("u1", 1, False), "mono16": ("u2", 1, False), "16UC1": ("u2", 1, False),
    "rgb8": ("u1", 3, False), "8UC3": ("u1", 3, False), "rgba8": ("u1", 4, False),
    "bgr8": ("u1", 3, True), "bgra8": ("u1", 4, True), "32FC1": ("f4", 1, False),
}  # fmt: skip
"""Encodings that can be read."""


class ImageError(ValueError):
    """An image does not fit its message; the text is a kind of error, so that equal ones can be counted."""


def levels_of(image: Image) -> Levels:
    """Return (height, width) uint8, uint16 or float32 of an image; raises ImageError."""
    if image.encoding not in ENCODINGS:
        raise ImageError("encoding not known")
    form, channels, is_bgr = ENCODINGS[image.encoding]
    pixels = _pixels(image, np.dtype(form).newbyteorder(">" if image.is_bigendian else "<"), channels)
    if channels > 1:
        rgb = pixels[:, :, 2::-1] if is_bgr else pixels[:, :, :3]
        luminance: Levels = np.rint(rgb.astype(np.float32) @ _RGB).astype(np.uint8)
        return luminance
    levels = pixels[:, :, 0].astype(form)
    if form == "f4" and not bool(np.all(np.isfinite(levels) & (levels >= 0))):
        raise ImageError("light that is negative or not finite")
    return levels


def _pixels(image: Image, form: np.dtype[Any], channels: int) -> npt.NDArray[Any]:
    """Return (height, width, channels), a view of the message."""
    width, height = image.size
    row = width * channels * form.itemsize
    data = memoryview(image.data).cast("B")
    if not 0 < width * height <= _MOST_PX:
        raise ImageError("no pixels, or too many")
    if image.step < row or image.step * height != len(data):
        raise ImageError("size and data do not agree")
    rows = np.frombuffer(data, np.uint8).reshape(height, image.step)[:, :row]
    return np.ascontiguousarray(rows).view(form).reshape(height, width, channels)
