"""AEDAT 2.0 records: bytes by hand, round trips, wraps, and any bytes."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EDGE, EVENT, EdgeKind
from firmware_protocol.recordings.aedat import (
    Aedat2Decoder,
    aedat2_header,
    encode_aedat2,
    guarded_start,
    parse_aedat2_header,
)

SIZE = (346, 260)


def events_at(times):
    events = np.zeros(len(times), EVENT)
    events["t"] = times
    rng = np.random.default_rng(len(times))
    events["x"], events["y"] = rng.integers(0, 346, len(times)), rng.integers(0, 260, len(times))
    events["on"] = rng.random(len(times)) < 0.5
    return events


def test_a_record_has_the_bits_of_a_davis_from_the_lower_right():
    events = np.array([(1000, 10, 20, True), (1001, 345, 259, False)], EVENT)
    raw = struct.pack(">IiIi", (259 - 20) << 22 | (345 - 10) << 12 | 1 << 11, 1000, 0, 1001)
    assert encode_aedat2(events, SIZE) == raw


def test_pin_events_have_their_own_codes():
    edges = np.array([(5, EdgeKind.FALLING, 0, 0), (6, EdgeKind.RISING, 0, 0), (7, EdgeKind.PULSE, 0, 0)], EDGE)
    records = encode_aedat2(events_at([6]), SIZE, edges)
    addresses = [struct.unpack_from(">I", records, 8 * k)[0] for k in (0, 1, 3)]
    assert addresses == [0x402, 0x403, 0x404]
    part = Aedat2Decoder(SIZE).decode(records)
    np.testing.assert_array_equal(part.edges[["t", "kind"]], edges[["t", "kind"]])
    np.testing.assert_array_equal(part.events, events_at([6]))


steps = st.lists(st.one_of(st.integers(0, 100), st.integers(0, 2**31 - 1)), min_size=1, max_size=40)


@given(steps, st.integers(1, 30))
def test_round_trip_across_wraps_in_pieces(steps, piece):
    events = events_at(np.cumsum(steps))
    data, decoder = encode_aedat2(events, SIZE), Aedat2Decoder(SIZE)
    read = [decoder.decode(data[k : k + piece]).events for k in range(0, len(data), piece)]
    np.testing.assert_array_equal(np.concatenate(read), events)
    assert (decoder.others, decoder.outside) == (0, 0)


def test_words_of_no_whole_frame_or_sample_are_counted_and_left_out():
    """A signal read without a reset read, a read of a kind that is no longer in use, six of the seven values."""
    imu = b"".join(struct.pack(">Ii", 0x8000_0C00 | k << 28, 2) for k in (0, 1, 2, 3, 4, 5, 0))
    raw = struct.pack(">IiIi", 0x8000_0400, 1, 0x8000_0800, 1) + imu + encode_aedat2(events_at([3]), SIZE)
    decoder = Aedat2Decoder(SIZE)
    part = decoder.decode(raw)
    assert part.events["t"].tolist() == [3]
    assert (len(part.imu), part.frames) == (0, ())
    assert decoder.others == 2 + 1  # six values may still be completed


@pytest.mark.parametrize("unix_us", [0, 1_700_000_000_123_000])
def test_the_header_tells_size_and_date(unix_us):
    head = aedat2_header(SIZE, unix_us)
    chip = "eu.seebetter.ini.chips.davis.davis346blue"
    assert parse_aedat2_header(head + b"\x00" * 8) == (len(head), SIZE, unix_us, chip)
    assert head.startswith(b"#!AER-DAT2.0\r\n")
    assert head.endswith(b"#End Of ASCII Header\r\n")


def test_the_first_record_never_looks_like_a_line_of_text():
    events = events_at([7])
    events["y"] = 259 - 140  # raw row 140: the address begins with 0x23, '#'
    records = encode_aedat2(events, SIZE)
    assert records[:1] == b"#"
    guarded = guarded_start(records)
    assert guarded[:1] != b"#"
    decoder = Aedat2Decoder(SIZE)
    np.testing.assert_array_equal(decoder.decode(guarded).events, events)
    assert guarded_start(records[1:]) == records[1:]


@given(st.binary(max_size=300))
def test_any_bytes_are_read_or_refused_in_words(data):
    events = Aedat2Decoder(SIZE).decode(data).events
    assert events["x"].max(initial=0) < 346
    assert events["y"].max(initial=0) < 260
    for head in (data, b"#!AER-DAT2.0\r\n#" + data):
        refused, start = "", 1
        try:
            start = parse_aedat2_header(head).start
        except ValueError as error:
            refused = str(error)
        assert not refused or "AEDAT 2.0" in refused or "no end" in refused
        assert 0 < start <= max(1, len(head))
