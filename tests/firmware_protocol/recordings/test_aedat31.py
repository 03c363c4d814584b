"""AEDAT 3.1 packets: bytes by hand, round trips, wraps, and any bytes."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.edges import EDGE
from firmware_protocol.events import EVENT
from firmware_protocol.recordings.aedat31 import (
    Aedat31Decoder,
    aedat31_header,
    encode_aedat31,
    parse_aedat31_header,
)


def events_at(times):
    events = np.zeros(len(times), EVENT)
    events["t"] = times
    rng = np.random.default_rng(len(times))
    events["x"], events["y"] = rng.integers(0, 1 << 15, len(times)), rng.integers(0, 1 << 15, len(times))
    events["on"] = rng.random(len(times)) < 0.5
    return events


def test_a_packet_has_the_fields_of_libcaer():
    events = np.array([(2**31 + 5, 3, 4, True)], EVENT)
    head = struct.pack("<hhiiiiii", 1, 1, 8, 4, 1, 1, 1, 1)
    assert encode_aedat31(events) == head + struct.pack("<Ii", 3 << 17 | 4 << 2 | 1 << 1 | 1, 5)


def test_special_events_carry_edges():
    edges = np.array([(5, 2, 0, 0), (6, 3, 0, 0), (7, 4, 0, 0)], EDGE)
    events, read = Aedat31Decoder().decode(encode_aedat31(events_at([]), edges))
    np.testing.assert_array_equal(read, edges)
    assert len(events) == 0


steps = st.lists(st.one_of(st.integers(0, 100), st.integers(0, 2**33)), max_size=40)


@given(steps, st.integers(1, 60))
def test_round_trip_across_wraps_in_pieces(steps, piece):
    events = events_at(np.cumsum(steps))
    data, decoder = encode_aedat31(events), Aedat31Decoder()
    read = [decoder.decode(data[k : k + piece])[0] for k in range(0, len(data), piece)]
    np.testing.assert_array_equal(np.concatenate([events[:0], *read]), events)


def test_other_packets_are_counted_and_left_out():
    frame = struct.pack("<hhiiiiii", 2, 1, 40, 12, 0, 1, 1, 1) + bytes(40)
    decoder = Aedat31Decoder()
    events, _ = decoder.decode(frame + encode_aedat31(events_at([9])))
    assert events["t"].tolist() == [9]
    assert decoder.others == 1


def test_events_that_are_marked_invalid_are_left_out():
    data = bytearray(encode_aedat31(events_at([1, 2])))
    data[28] &= 0xFE
    assert Aedat31Decoder().decode(bytes(data))[0]["t"].tolist() == [2]


def test_the_header_names_the_camera():
    head = aedat31_header("DAVIS346")
    assert parse_aedat31_header(head + b"\0") == (len(head), "DAVIS346")
    with pytest.raises(ValueError, match="does not begin with"):
        parse_aedat31_header(b"#!AER-DAT3.0\r\n")
    with pytest.raises(ValueError, match="no end"):
        parse_aedat31_header(head[:-3])


@given(st.binary(max_size=300))
def test_any_bytes_are_read_or_refused_in_words(data):
    for start in (b"", struct.pack("<hhiii", 1, 1, 8, 4, 0)):
        refused = ""
        try:
            Aedat31Decoder().decode(start + data)
        except ValueError as error:
            refused = str(error)
        assert not refused or "a packet of kind" in refused
