"""Messages of ROS 2: `event_camera_msgs/EventPacket` is written, `sensor_msgs/Image` written and read.

    both          i32 s   u32 ns   frame_id                               std_msgs/Header: Unix time of the first event
    EventPacket   u32 height   u32 width   u64 seq   u64 time_base, ns   encoding   u8 is_bigendian   u8[] events
    Image         u32 height   u32 width   encoding   u8 is_bigendian   u32 step   u8[] data

The events of the encoding "evt3" are Prophesee's words of 16 bits, whose times are the camera's own. Those of "mono"
are words of 64 bits: 32 of time, ns after `time_base`; 16 of x, 15 of y; polarity.

ROS 2 gives each type a hash over its definition (RIHS01), which a writer tells in its user data: `ros2 topic info -v`
shows it, and ROS warns where reader and writer differ.

Sources: ros-event-camera/event_camera_msgs, message and codecs; ros2/common_interfaces, sensor_msgs; REP 2011 for the
hashes (computed by rosbags 0.11).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from firmware_protocol.events import Events
from firmware_protocol.ros2.cdr import CdrReader, CdrWriter, Octets

__all__ = ["EVENT_PACKET", "IMAGE", "Header", "Image", "MessageType", "event_packet", "image_message", "mono_events",
           "parse_image"]  # fmt: skip

_S_NS = 1_000_000_000
_MOST_MONO_NS = (1 << 32) - 1


@dataclass(frozen=True)
class MessageType:
    """A type of messages.

    Attributes
    ----------
    ros
        Its name in ROS, "package/msg/Name".
    rihs01
        Hash of its definition, hexadecimal.
    """

    ros: str
    rihs01: str

    @property
    def user_data(self) -> bytes:
        """What a writer or reader of ROS 2 tells of the type."""
        return f"typehash=RIHS01_{self.rihs01};".encode("ascii")


EVENT_PACKET = MessageType(
    "event_camera_msgs/msg/EventPacket", "d6fa176260b1f37e5a40845305315e150a0f18191241eb64f407442aa29844aa"
)
IMAGE = MessageType("sensor_msgs/msg/Image", "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47")


@dataclass(frozen=True)
class Header:
    """When and where: Unix time, ns, and the name of the camera's frame."""

    stamp_ns: int
    frame_id: str


@dataclass(frozen=True, eq=False)
class Image:
    """A picture.

    Attributes
    ----------
    size
        (width, height), pixels.
    encoding
        "rgb8", "mono16", ...
    step
        Bytes of a row.
    """

    header: Header
    size: tuple[int, int]
    encoding: str
    step: int
    data: Octets
    is_bigendian: bool = False


def event_packet(header: Header, size: tuple[int, int], seq: int, encoding: str, events: bytes, base_ns: int) -> bytes:
    """Return a message of events that are coded as `encoding` says, of a sensor of `size` = (width, height)."""
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
    """Return the message of a picture."""
    message = _begun(image.header, image.size)
    message.text(image.encoding)
    message.number("B", image.is_bigendian)
    message.number("I", image.step)
    message.octets(image.data)
    return message.message()


def parse_image(message: bytes) -> Image:
    """Return the picture of a message, its data not copied and not checked; raises CdrError."""
    reader = CdrReader(message)
    stamp_ns = reader.number("i") * _S_NS + reader.number("I")
    header = Header(stamp_ns, reader.text())
    height, width = reader.number("I"), reader.number("I")
    encoding, is_bigendian, step = reader.text(), reader.number("B") != 0, reader.number("I")
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
