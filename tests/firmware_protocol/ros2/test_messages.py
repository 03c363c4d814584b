"""Messages of ROS 2 beside those of rosbags, hashes of types, and messages that are damaged."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from firmware_protocol.events import EVENT
from firmware_protocol.ros2 import (
    ENCODINGS,
    EVENT_PACKET,
    IMAGE,
    CdrError,
    CdrReader,
    Header,
    Image,
    ImageError,
    event_packet,
    image_message,
    levels_of,
    mono_events,
    parse_image,
)

# Of ros-event-camera/event_camera_msgs.
DEFINITION = """
std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events
"""
TYPES = get_typestore(Stores.ROS2_JAZZY)
TYPES.register(get_types_from_msg(DEFINITION, EVENT_PACKET.ros))
HEADER = Header(1_763_000_000_123_456_789, "event_camera")

texts = st.text(st.characters(min_codepoint=32, max_codepoint=0x24F), max_size=9)
headers = st.builds(Header, st.integers(0, 2**31 * 10**9 - 1), texts)
u32 = st.integers(0, 2**32 - 1)


def theirs(kind, **fields):
    return TYPES.types[kind](**fields)


def their_header(header):
    stamp = theirs("builtin_interfaces/msg/Time", sec=header.stamp_ns // 10**9, nanosec=header.stamp_ns % 10**9)
    return theirs("std_msgs/msg/Header", stamp=stamp, frame_id=header.frame_id)


def filled(message):
    """Return their message, filled up to a multiple of four as DDS sends it."""
    return bytes(message) + bytes(-len(message) % 4)


@pytest.mark.parametrize("kind", [EVENT_PACKET, IMAGE])
def test_the_hashes_of_types_are_those_of_rosbags(kind):
    assert TYPES.hash_rihs01(kind.ros) == f"RIHS01_{kind.rihs01}"


@given(headers, u32, u32, st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1), texts, st.binary(max_size=21))
def test_packets_of_events_are_those_of_rosbags(header, width, height, seq, base_ns, encoding, events):
    ours = event_packet(header, (width, height), seq, encoding, events, base_ns)
    message = theirs(
        EVENT_PACKET.ros, header=their_header(header), height=height, width=width, seq=seq, time_base=base_ns,
        encoding=encoding, is_bigendian=False, events=np.frombuffer(events, np.uint8),
    )  # fmt: skip
    assert ours == filled(TYPES.serialize_cdr(message, EVENT_PACKET.ros))


@given(headers, u32, u32, texts, u32, st.booleans(), st.binary(max_size=21), st.booleans())
def test_images_are_those_of_rosbags_both_ways(header, width, height, encoding, step, is_bigendian, data, is_little):
    message = theirs(
        IMAGE.ros, header=their_header(header), height=height, width=width, encoding=encoding,
        is_bigendian=int(is_bigendian), step=step, data=np.frombuffer(data, np.uint8),
    )  # fmt: skip
    image = Image(header, (width, height), encoding, step, data, is_bigendian)
    assert image_message(image) == filled(TYPES.serialize_cdr(message, IMAGE.ros))
    read = parse_image(bytes(TYPES.serialize_cdr(message, IMAGE.ros, little_endian=is_little)))
    assert (read.header, read.size, read.encoding, read.step) == (header, (width, height), encoding, step)
    assert (bytes(read.data), read.is_bigendian) == (data, is_bigendian)


def test_mono_words_hold_time_place_and_polarity():
    events = np.array([(5, 345, 259, True), (5, 0, 0, False), (4_294_972, 32_767, 32_767, True)], EVENT)
    data, base_ns = mono_events(events)
    assert base_ns == 5000
    words = [int.from_bytes(data[k : k + 8], "little") for k in range(0, 24, 8)]
    assert words == [345 << 32 | 259 << 48 | 1 << 63, 0, 4_294_967_000 | 32_767 << 32 | 32_767 << 48 | 1 << 63]
    events["t"][2] += 1
    with pytest.raises(ValueError, match=r"4\.29 s"):
        mono_events(events)


@given(st.binary(max_size=60), st.integers(0, 60), st.integers(0, 255))
def test_damaged_messages_are_refused_or_read_within_their_bounds(noise, at, value):
    whole = bytearray(image_message(Image(HEADER, (4, 2), "mono8", 4, bytes(8))))
    whole[at % len(whole)] = value
    for message in (noise, bytes(whole), bytes(whole[: at % len(whole)])):
        try:
            levels = levels_of(parse_image(message))
        except (CdrError, ImageError):
            continue
        assert levels.size <= len(message)


def test_a_length_beyond_the_message_is_refused():
    message = image_message(Image(HEADER, (4, 2), "mono8", 4, bytes(8)))
    cut = message[: len(message) - 4]
    with pytest.raises(CdrError, match="cut"):
        parse_image(cut)
    with pytest.raises(CdrError, match="plain CDR"):
        CdrReader(b"\0\3\0\0" + message[4:])  # a parameter list


@pytest.mark.parametrize("is_bigendian", [False, True])
@pytest.mark.parametrize("encoding", sorted(ENCODINGS))
def test_levels_of_each_encoding(encoding, is_bigendian):
    """Random pixels in rows with padding, taken apart number by number."""
    rng = np.random.default_rng(3)
    form, channels, is_bgr = ENCODINGS[encoding]
    dtype = np.dtype(form).newbyteorder(">" if is_bigendian else "<")
    pixels = rng.integers(0, 256, (3, 5, channels)).astype(dtype) * (257 if form == "u2" else 1)
    rows = [row.astype(dtype).tobytes() + b"pad" for row in pixels]
    levels = levels_of(Image(HEADER, (5, 3), encoding, len(rows[0]), b"".join(rows), is_bigendian))
    assert levels.shape == (3, 5)
    for row in range(3):
        for column in range(5):
            numbers = [float(n) for n in pixels[row, column]]
            red, green, blue = (numbers[2::-1] if is_bgr else numbers[:3]) if channels > 1 else numbers * 3
            assert levels[row, column] == pytest.approx(0.2126 * red + 0.7152 * green + 0.0722 * blue, abs=0.51)
    assert levels.dtype == {"u1": np.uint8, "u2": np.uint16, "f4": np.float32}[form]


@pytest.mark.parametrize(("image", "reason"), [
    (Image(HEADER, (4, 2), "yuv422", 8, bytes(16)), "encoding"),
    (Image(HEADER, (4, 2), "mono8", 3, bytes(6)), "do not agree"),
    (Image(HEADER, (4, 2), "mono8", 4, bytes(7)), "do not agree"),
    (Image(HEADER, (4, 2), "mono8", 4, bytes(400)), "do not agree"),
    (Image(HEADER, (0, 2), "mono8", 0, b""), "no pixels"),
    (Image(HEADER, (2**32 - 1, 2**32 - 1), "mono8", 2**32 - 1, bytes(16)), "too many"),
    (Image(HEADER, (1, 1), "32FC1", 4, np.float32(np.nan).tobytes()), "not finite"),
    (Image(HEADER, (1, 1), "32FC1", 4, np.float32(-1).tobytes()), "negative"),
])  # fmt: skip
def test_images_that_cannot_be_are_refused(image, reason):
    with pytest.raises(ImageError, match=reason):
        levels_of(parse_image(image_message(image)))
