"""AEDAT 3.1 packets: bytes by hand, round trips, wraps, and any bytes."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EDGE, EVENT
from firmware_protocol.recordings.aedat import (
    Aedat31Decoder,
    aedat31_header,
    encode_aedat31,
    encode_frame,
    encode_imu,
    parse_aedat31_header,
)
from firmware_protocol.recordings.part import IMU, Frame
from tests.made_events import scattered


def test_a_packet_has_the_fields_of_libcaer():
    events = np.array([(2**31 + 5, 3, 4, True)], EVENT)
    head = struct.pack("<hhiiiiii", 1, 1, 8, 4, 1, 1, 1, 1)
    assert encode_aedat31(events) == head + struct.pack("<Ii", 3 << 17 | 4 << 2 | 1 << 1 | 1, 5)


def test_special_events_carry_edges():
    edges = np.array([(5, 2, 0, 0), (6, 3, 0, 0), (7, 4, 0, 0)], EDGE)
    part = Aedat31Decoder().decode(encode_aedat31(scattered([]), edges))
    np.testing.assert_array_equal(part.edges, edges)
    assert len(part.events) == 0


def test_a_frame_has_the_fields_of_libcaer():
    frame = Frame(2**31 + 5, 2**31 + 5, 2**31 + 9, np.array([[0, 1, 2], [512, 1022, 1023]], np.uint16), (7, 8))
    head = struct.pack("<hhiiiiii", 2, 1, 48, 4, 1, 1, 1, 1)
    body = struct.pack("<I8i6H", 3, 5, 9, 5, 9, 3, 2, 7, 8, 0, 64, 128, 32768, 65408, 65472)
    assert encode_frame(frame) == head + body
    (read,) = Aedat31Decoder().decode(head + body).frames
    assert (read.t_us, read.exposure_begin_us, read.exposure_end_us, read.origin) == (
        2**31 + 5, 2**31 + 5, 2**31 + 9, (7, 8),
    )  # fmt: skip
    np.testing.assert_array_equal(read.pixels, frame.pixels)
    assert Aedat31Decoder().decode(head + body[:-1]).frames == ()


def test_samples_have_the_fields_of_libcaer():
    imu = np.zeros(2, IMU)
    imu["t"], imu["temperature"], imu["gyroscope_z"], imu["accelerometer_x"] = [3, 4], 30, -2.5, 0.5
    data = struct.pack("<hhiiiiii", 3, 1, 36, 4, 0, 2, 2, 2)
    data += b"".join(struct.pack("<Ii7f", 1, t, 0.5, 0, 0, 0, 0, -2.5, 30) for t in (3, 4))
    assert encode_imu(imu) == data
    np.testing.assert_array_equal(Aedat31Decoder().decode(data).imu, imu)


steps = st.lists(st.one_of(st.integers(0, 100), st.integers(0, 2**33)), max_size=40)


@given(steps, st.integers(1, 60))
def test_round_trip_across_wraps_in_pieces(steps, piece):
    events = scattered(np.cumsum(steps))
    data, decoder = encode_aedat31(events), Aedat31Decoder()
    read = [decoder.decode(data[k : k + piece]).events for k in range(0, len(data), piece)]
    np.testing.assert_array_equal(np.concatenate([events[:0], *read]), events)


def test_other_packets_and_frames_that_cannot_be_read_are_left_out():
    colours = struct.pack("<hhiiiiii", 2, 1, 42, 4, 0, 1, 1, 1) + struct.pack("<I8i3H", 7, *[0] * 4, 1, 1, *[0] * 5)
    larger = struct.pack("<hhiiiiii", 2, 1, 38, 4, 0, 1, 1, 1) + struct.pack("<I8iH", 3, *[0] * 4, 9, 9, 0, 0, 1)
    nine_axes = struct.pack("<hhiiiiii", 4, 1, 48, 4, 0, 1, 1, 1) + bytes(48)
    decoder = Aedat31Decoder()
    part = decoder.decode(colours + larger + nine_axes + encode_aedat31(scattered([9])))
    assert part.events["t"].tolist() == [9]
    assert part.frames == ()


def test_events_that_are_marked_invalid_are_left_out():
    data = bytearray(encode_aedat31(scattered([1, 2])))
    data[28] &= 0xFE
    assert Aedat31Decoder().decode(bytes(data)).events["t"].tolist() == [2]


def test_the_header_names_the_camera():
    head = aedat31_header("DAVIS346")
    assert parse_aedat31_header(head + b"\0") == (len(head), "DAVIS346")
    with pytest.raises(ValueError, match="does not begin with"):
        parse_aedat31_header(b"#!AER-DAT3.0\r\n")
    with pytest.raises(ValueError, match="no end"):
        parse_aedat31_header(head[:-3])


BODIES = {
    0: lambda t: struct.pack("<Ii", 2 << 1 | 1, t),
    1: lambda t: struct.pack("<Ii", 1, t),
    2: lambda t: struct.pack("<I8iH", 3, t, t, t, t, 1, 1, 0, 0, 64),
    3: lambda t: struct.pack("<Ii7f", 1, t, *[0.0] * 7),
}


@pytest.mark.parametrize("kind", BODIES)
@pytest.mark.parametrize(("times", "wraps"), [([3, -5, 7], 0), ([2**31 - 1, 2**31 - 2], -1)])
def test_a_negative_time_is_damage_and_what_lies_before_is_read(kind, times, wraps):
    body = [BODIES[kind](t) for t in times]
    head = struct.pack("<hhiiiiii", kind, 1, len(body[0]), 4, wraps, *[len(body)] * 3)
    decoder, before = Aedat31Decoder(), encode_aedat31(scattered([1, 2]))
    part = decoder.decode(before + head + b"".join(body) + before)
    assert part.events["t"].tolist() == [1, 2] + ([3] if kind == 1 and not wraps else [])
    assert len(part.edges) + len(part.imu) + len(part.frames) == (kind != 1 and not wraps)
    k, t_us = (0, -1) if wraps else (1, -5)
    assert decoder.damage == f"it is damaged: record {k} of packet 1 has the time {t_us} us"
    assert len(decoder.decode(before).events) == 0


@given(st.binary(max_size=300))
def test_any_bytes_are_read_or_refused_in_words(data):
    for start in (b"", struct.pack("<hhiii", 1, 1, 8, 4, 0)):
        decoder = Aedat31Decoder()
        assert len(decoder.decode(start + data).events) < 30
        assert not decoder.damage or "packet 0" in decoder.damage
