"""Words of sensors, and bytes of nobody, read by our decoder and by another."""

import numpy as np
from evt3_streams import by_evt3, streams
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EDGE, EVENT, EdgeKind, make_edges
from firmware_protocol.evt.evt3 import Evt3Decoder, Evt3Encoder


def as_bytes(*words):
    return np.array(words, "<u2").tobytes()


def test_words_by_hand_are_the_events_of_the_published_format():
    """Vectors move their base on; other words and the continuations of 0xE are not events."""
    data = as_bytes(
        0x2805, 0x8001, 0x6002, 0x0803, 0x2805, 0xE014, 0xF123, 0xF456, 0x7007, 0x9999, 0x3010, 0x4801, 0x5081, 0x6003,
        0x4001, 0xA201,
    )  # fmt: skip
    events, edges = Evt3Decoder().decode(data)
    assert events.tolist() == [
        (0x1002, 5, 3, True), (0x1002, 16, 3, False), (0x1002, 27, 3, False), (0x1002, 28, 3, False),
        (0x1002, 35, 3, False), (0x1003, 36, 3, False),
    ]  # fmt: skip
    assert edges.tolist() == [(0x1003, EdgeKind.RISING, 2, 0)]


def test_a_high_part_that_goes_back_by_more_than_half_is_a_wrap():
    data = as_bytes(0x8FFF, 0x6001, 0x2000, 0x8000, 0x6002, 0x2000, 0x8800, 0x2000, 0x8000, 0x2000)
    assert Evt3Decoder().decode(data)[0]["t"].tolist() == [0xFFF001, 0x1000002, 0x1800000, 0x1000000]


def test_vectors_of_real_sensors_are_read_as_another_decoder_reads_them():
    rng = np.random.default_rng(4)
    words = [0x8010, 0x6001]
    for k in range(300):
        row, first, second, third, on = (int(n) for n in rng.integers(0, [720, 4096, 4096, 4096, 2]))
        words += [0x6000 | k, row, 0x3000 | on << 11 | 8 * (k % 100), 0x4000 | first, 0x4000 | second, 0x5000 | third]
        words += [0x2000 | (1 - on) << 11 | k] if k % 3 else []
    data = as_bytes(*words)
    ours, theirs = Evt3Decoder().decode(data)[0], by_evt3(data)
    assert len(ours) > 4000
    np.testing.assert_array_equal(ours, theirs)


@given(streams(), st.integers(1, 99))
def test_words_may_come_in_pieces_of_any_size(events, piece):
    edges = make_edges(events["t"][::7], EdgeKind.FALLING)
    data = Evt3Encoder().encode(events, edges)
    decoder = Evt3Decoder()
    parts = [decoder.decode(data[k : k + piece]) for k in range(0, len(data), piece)]
    np.testing.assert_array_equal(np.concatenate([np.zeros(0, EVENT), *(part[0] for part in parts)]), events)
    np.testing.assert_array_equal(np.concatenate([np.zeros(0, EDGE), *(part[1] for part in parts)]), edges)


def reference(words):
    """Return events and edges as the format tells them, word by word, in plain Python."""
    high, low, row, column, on = None, 0, 0, 0, 0
    events, edges = [], []
    for word in words:
        kind, value = word >> 12, word & 0xFFF
        if kind == 8:
            old = value if high is None else high
            high, low = (old & ~0xFFF) + (0x1000 if (old & 0xFFF) - value > 2048 else 0) + value, 0
        if high is None:
            continue
        if kind == 0:
            row = value & 0x7FF
        elif kind == 2:
            events.append(((high << 12) + low, value & 0x7FF, row, value > 0x7FF))
        elif kind == 3:
            column, on = value & 0x7FF, value > 0x7FF
        elif kind in (4, 5):
            width = 12 if kind == 4 else 8
            events += [((high << 12) + low, column + k & 0xFFFF, row, on) for k in range(width) if value >> k & 1]
            column += width
        elif kind == 6:
            low = value
        elif kind == 10:
            edges.append(((high << 12) + low, 2 if value & 1 else 3, value >> 8, 0))
    return events, edges


@given(st.lists(st.one_of(st.integers(0, 0xFFFF), st.integers(0x4000, 0x4FFF)), max_size=200), st.integers(1, 50))
def test_any_words_in_any_pieces_are_read_as_the_format_has_them(words, piece):
    """Columns pass the last one that has a number, time goes back, and no more than 12 events come of a word."""
    data, decoder = as_bytes(*words), Evt3Decoder()
    parts = [decoder.decode(data[k : k + piece]) for k in range(0, len(data) + 1, piece)]
    for k, (record, expected) in enumerate(zip((EVENT, EDGE), reference(words), strict=True)):
        np.testing.assert_array_equal(np.concatenate([part[k] for part in parts]), np.array(expected, record))


def test_without_a_time_nothing_is_read_and_nothing_is_kept():
    decoder = Evt3Decoder()
    for _ in range(3):
        events, edges = decoder.decode(as_bytes(*[0x2001, 0xA001, 0x6001] * 100))
        assert len(events) == len(edges) == 0
    assert len(decoder.decode(as_bytes(0x8001, 0x2001))[0]) == 1
