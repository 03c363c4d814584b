"""The words of a DVXplorer: vectors written by hand from the protocol, and any stream against a slow reader."""

import numpy as np
import pytest
from davis_host import events_of
from davis_strategies import cut
from dvxplorer_host import scans, scattered, streams
from dvxplorer_reader import Reader, read
from hypothesis import example, given
from hypothesis import strategies as st

from firmware_protocol.dvxplorer.decoder import GroupDecoder
from firmware_protocol.dvxplorer.words import GroupEncoder
from firmware_protocol.events import empty_events

SIZE = (640, 480)


def words(*rows, compressed=True, **options):
    encoder = GroupEncoder(SIZE)
    encoder.compressed = compressed
    return encoder.encode(events_of(*rows), **options).words.tolist()


VECTORS = {
    "one event: time, column of a new scan, group 3, row 5 of it, ON": (
        [(5, 3, 29, True)],
        [0x8005, 0x1803, 0x4003, 0x3020],
    ),
    "rows that rise in a group share a word": (
        [(0, 639, 472, False), (0, 639, 475, False), (0, 639, 479, False)],
        [0x1A7F, 0x403B, 0x3189],
    ),
    "rows that fall do not": ([(0, 0, 9, True), (0, 0, 8, True)], [0x1800, 0x4001, 0x3002, 0x2001]),
    "two groups 31 apart share their addresses": (
        [(0, 1, 0, True), (0, 1, 248, False)],
        [0x1801, 0x47C0, 0x3001, 0x2101],
    ),
    "so do groups in falling order": (
        [(0, 1, 100, True), (0, 1, 50, True)],
        [0x1801, 0x4800 | 6 << 6 | 12, 0x3010, 0x2004],
    ),
    "and both polarities of one group": ([(0, 1, 8, True), (0, 1, 8, False)], [0x1801, 0x4001, 0x3001, 0x2101]),
    "groups 32 apart do not": ([(0, 1, 0, True), (0, 1, 256, True)], [0x1801, 0x4000, 0x3001, 0x4020, 0x3001]),
    "a third group has its own addresses": (
        [(0, 1, 0, True), (0, 1, 8, True), (0, 1, 16, True)],
        [0x1801, 0x4040, 0x3001, 0x2001, 0x4002, 0x3001],
    ),
    "a further column of a scan has no start": (
        [(0, 4, 0, True), (1, 7, 0, True), (9, 7, 0, True), (9, 6, 0, True)],
        [
            0x1804,
            0x4000,
            0x3001,
            0x8001,
            0x1007,
            0x4000,
            0x3001,
            0x8009,
            0x1807,
            0x4000,
            0x3001,
            0x1806,
            0x4000,
            0x3001,
        ],
    ),
    "a wrap sets the time by itself": (
        [(32768, 4, 0, True), (65537, 5, 0, True)],
        [0x7001, 0x1804, 0x4000, 0x3001, 0x7001, 0x8001, 0x1005, 0x4000, 0x3001],
    ),
}


@pytest.mark.parametrize("name", VECTORS)
def test_vectors(name):
    rows, expected = VECTORS[name]
    assert words(*rows) == expected
    assert read(np.array(expected, "<u2").tobytes()).events == rows


def test_a_long_gap_takes_few_words_and_days_are_refused():
    (*wraps, low, _, _, _) = words((5000 * 32768 + 1, 0, 0, True))
    assert (sum(word & 0xFFF for word in wraps), low) == (5000, 0x8001)
    assert len(wraps) == 1 + 5000 - 4095
    with pytest.raises(ValueError, match="12 days"):
        words((1 << 41, 0, 0, True))


@pytest.mark.parametrize(
    ("rows", "why"),
    [
        ([(5, 0, 0, True), (4, 0, 0, True)], "sorted"),
        ([(5, 640, 0, True)], "outside"),
        ([(5, 0, 480, True)], "outside"),
        ([(5, 0, 479, True), (5, 0, 480, True)], "outside"),
        ([(5, 65535, 65535, True)], "outside"),
    ],
)
def test_wrong_events_are_refused_and_the_state_stays(rows, why):
    encoder = GroupEncoder(SIZE)
    before = encoder.state
    with pytest.raises(ValueError, match=why):
        encoder.encode(events_of(*rows))
    assert encoder.state == before


@given(events=streams(), cuts=st.lists(st.integers(0, 60), max_size=4), compressed=st.booleans())
@example(events=scans(3000), cuts=[1000, 1001], compressed=True)
@example(events=scans(3000), cuts=[], compressed=False)
@example(events=scattered(2000), cuts=[7], compressed=True)
def test_any_stream_comes_back_in_order(events, cuts, compressed):
    encoder = GroupEncoder(SIZE)
    encoder.compressed = compressed
    encoded = [encoder.encode(part) for part in cut(events, cuts)]
    data = b"".join(one.words.tobytes() for one in encoded)
    reader = read(data)
    assert reader.wrong == []
    assert reader.events == events.tolist()
    assert sum(one.events_in(one.words) for one in encoded) == len(events)
    own = GroupDecoder()
    assert own.feed(data).events.tolist() == events.tolist()
    assert own.faults.total == 0


@given(events=streams(max_size=30), room=st.integers(0, 130))
def test_words_up_to_an_end_hold_whole_events(events, room):
    encoded = GroupEncoder(SIZE).encode(events)
    ends = encoded.ends
    fitting = int(ends[np.searchsorted(ends, room, side="right") - 1]) if len(ends) and ends[0] <= room else 0
    reader = read(encoded.words[:fitting].tobytes())
    assert reader.wrong == []
    assert len(reader.events) == encoded.events_in(encoded.words[:fitting])
    assert reader.events == events.tolist()[: len(reader.events)]


@given(data=st.binary(max_size=300), cuts=st.lists(st.integers(0, 300), max_size=3))
@example(data=np.array([0x4000, 0x1000, 0x2201], "<u2").tobytes(), cuts=[])
def test_any_bytes_decode_as_the_slow_reader_does(data, cuts):
    """Events agree for any words, valid or not; only states that the description leaves open are left out."""
    data = data[: len(data) & ~1]
    slow, own = Reader(), GroupDecoder()
    slow.feed(bytes(data))
    found = np.concatenate([empty_events(), *[own.feed(part).events for part in cut(data, cuts)]])
    assert found.tolist() == [e for e in slow.events if e[1] < 640 and 0 <= e[2] < 480]
    outside = [one for one in slow.wrong if one.startswith("column") and int(one.split()[1], 16) & 0x3FF >= 640]
    assert own.faults.column_outside == len(outside)


def test_the_decoder_counts_each_kind_of_fault():
    own = GroupDecoder()
    own.feed(np.array([0x1280, 0x403C, 0x8005, 0x8005, 0x0009, 0x5700, 0x6000], "<u2").tobytes())
    faults = own.faults
    assert (faults.column_outside, faults.row_outside, faults.time_not_increasing) == (1, 1, 1)
    assert (faults.unknown_special, faults.unknown_misc) == (1, 2)


def test_statistics_of_words():
    encoder = GroupEncoder(SIZE)
    encoded = encoder.encode(scans(1000))
    reader = read(encoded.words.tobytes())
    assert encoder.rows == len({(t, x) for t, x, _, _ in reader.events})
    assert len(reader.scans) == 2
    encoder.count(encoded.words[:100], encoded.words[100:])
    counted = encoder.groups + encoder.dropped_groups
    assert counted == sum(1 for word in encoded.words.tolist() if word >> 12 in (2, 3))
