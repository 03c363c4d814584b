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
from tests.made_events import scattered

SIZE = (346, 260)


def test_a_record_has_the_bits_of_a_davis_from_the_lower_right():
    events = np.array([(1000, 10, 20, True), (1001, 345, 259, False)], EVENT)
    raw = struct.pack(">IiIi", (259 - 20) << 22 | (345 - 10) << 12 | 1 << 11, 1000, 0, 1001)
    assert encode_aedat2(events, SIZE) == raw


def test_pin_events_have_their_own_codes():
    edges = np.array([(5, EdgeKind.FALLING, 0, 0), (6, EdgeKind.RISING, 0, 0), (7, EdgeKind.PULSE, 0, 0)], EDGE)
    records = encode_aedat2(scattered([6]), SIZE, edges)
    assert [struct.unpack_from(">I", records, 8 * k)[0] for k in (0, 1, 3)] == [0x402, 0x403, 0x404]
    part = Aedat2Decoder(SIZE).decode(records)
    np.testing.assert_array_equal(part.edges[["t", "kind"]], edges[["t", "kind"]])
    np.testing.assert_array_equal(part.events, scattered([6]))


steps = st.lists(st.one_of(st.integers(0, 100), st.integers(0, 2**31 - 1)), min_size=1, max_size=40)


@given(steps, st.integers(1, 30))
def test_round_trip_across_wraps_in_pieces(steps, piece):
    events = scattered(np.cumsum(steps))
    data, decoder = encode_aedat2(events, SIZE), Aedat2Decoder(SIZE)
    read = [decoder.decode(data[k : k + piece]).events for k in range(0, len(data), piece)]
    np.testing.assert_array_equal(np.concatenate(read), events)
    assert decoder.outside == 0


def test_words_of_no_whole_frame_or_sample_are_left_out():
    """A signal read without a reset read, a read of a kind that is no longer in use, six of the seven values."""
    imu = b"".join(struct.pack(">Ii", 0x8000_0C00 | k << 28, 2) for k in (0, 1, 2, 3, 4, 5, 0))
    raw = struct.pack(">IiIi", 0x8000_0400, 1, 0x8000_0800, 1) + imu + encode_aedat2(scattered([3]), SIZE)
    decoder = Aedat2Decoder(SIZE)
    part = decoder.decode(raw)
    assert part.events["t"].tolist() == [3]
    assert (len(part.imu), part.frames) == (0, ())


@pytest.mark.parametrize("unix_us", [0, 1_700_000_000_123_000])
def test_the_header_tells_size_and_date(unix_us):
    head = aedat2_header(SIZE, unix_us)
    chip = "eu.seebetter.ini.chips.davis.davis346blue"
    assert parse_aedat2_header(head + b"\x00" * 8) == (len(head), SIZE, unix_us, chip)
    assert head.startswith(b"#!AER-DAT2.0\r\n")
    assert head.endswith(b"#End Of ASCII Header\r\n")


def test_the_first_record_never_looks_like_a_line_of_text():
    events = scattered([7])
    events["y"] = 259 - 140  # raw row 140: the address begins with 0x23, '#'
    records = encode_aedat2(events, SIZE)
    assert records[:1] == b"#"
    guarded = guarded_start(records)
    assert guarded[:1] != b"#"
    decoder = Aedat2Decoder(SIZE)
    np.testing.assert_array_equal(decoder.decode(guarded).events, events)
    assert guarded_start(records[1:]) == records[1:]


DVS128 = b"#!AER-DAT2.0\r\n# AEChip: ch.unizh.ini.jaer.chip.retina.DVS128\r\n"
OF_DVS128 = bytes.fromhex("000007f400000064 00001437000000c8 00005a860000012c 000078eb00000190")


@pytest.mark.parametrize("head", [DVS128, b"#!AER-DAT2.0\r\n# created Thu\r\n", DVS128.replace(b"DVS", b"Tmpdiff")])
def test_addresses_of_a_dvs128_have_their_own_bits(head):
    parsed = parse_aedat2_header(head + OF_DVS128)
    assert (parsed.start, parsed.size) == (len(head), None if b"created" in head else (128, 128))
    decoder = Aedat2Decoder((128, 128), parsed.chip)
    part = decoder.decode(OF_DVS128 + struct.pack(">IiIi", 0x8000, 500, 0x1_07F4, 600))
    events = [(100, 5, 120, True), (200, 100, 107, False), (300, 60, 37, True), (400, 10, 7, False)]
    assert part.events.tolist() == events
    assert part.edges.tolist() == [(500, EdgeKind.PULSE, 0, 0)]
    assert (len(part.imu), part.frames, decoder.outside) == (0, (), 1)  # an address of 17 bits


def test_a_davis_or_our_own_sensor_of_that_size_keeps_the_bits_of_a_davis():
    size, events = (128, 128), np.array([(5, 10, 20, True), (6, 127, 127, False)], EVENT)
    for line in (aedat2_header(size), b"#!AER-DAT2.0\r\n# AEChip: eu.seebetter.ini.chips.davis.DAVIS208\r\n"):
        chip = parse_aedat2_header(line).chip
        np.testing.assert_array_equal(Aedat2Decoder(size, chip).decode(encode_aedat2(events, size)).events, events)


def test_a_chip_with_other_addresses_is_refused_by_its_name():
    head = b"#!AER-DAT2.0\r\n# AEChip: ch.unizh.ini.jaer.chip.cochlea.CochleaAMS1c\r\n"
    with pytest.raises(ValueError, match=r"AEDAT 2\.0 file of the chip .*cochleaams1c"):
        parse_aedat2_header(head)


@pytest.mark.parametrize(("times", "read", "damage"), [
    ([5, 100, -7, 200], [5, 100], "it is damaged: record 2 has the time -7 us"),
    ([-5, -3, 0, 9], [2**32 - 5, 2**32 - 3, 2**32, 2**32 + 9], ""),
    ([2**31 - 1, -(2**31), 2**31 - 2], [2**31 - 1, 2**31, 2**31 - 2], ""),
    ([100, 300, 200], [100, 300, 200], ""),
])  # fmt: skip
@pytest.mark.parametrize("piece", [3, 8, 99])
def test_times_stay_as_they_are_stored_and_a_negative_one_is_damage(times, read, damage, piece):
    data, decoder = b"".join(struct.pack(">Ii", 0, t) for t in times), Aedat2Decoder(SIZE)
    parts = [decoder.decode(data[k : k + piece]) for k in range(0, len(data), piece)]
    assert np.concatenate([part.events["t"] for part in parts]).tolist() == read
    assert decoder.damage == damage


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
