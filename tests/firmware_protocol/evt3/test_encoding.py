"""EVT3 words of events: by hand from the format's document, by readers of others, and by our own."""

from itertools import pairwise

import numpy as np
import pytest
from evt3_streams import SIZE, WRAP_US, by_evt3, long_steps_us, streams
from hypothesis import example, given
from hypothesis import strategies as st

from firmware_protocol.events import EDGE, EVENT, EdgeKind, make_edges
from firmware_protocol.evt.evt3 import Evt3Decoder, Evt3Encoder
from firmware_protocol.evt.words import evt3_header
from tests.made_events import events_at


def group(t, y, on, columns):
    return np.array([(t, x, y, on) for x in columns], EVENT)


def words_of(events, edges=None, **settings):
    return [hex(word) for word in np.frombuffer(Evt3Encoder(**settings).encode(events, edges), "<u2")]


def by_hand(*words):
    return [hex(word) for word in words]


def test_single_events_are_the_words_of_the_published_format():
    events = np.array([(0x123456, 5, 7, True), (0x123456, 6, 7, False), (0x123457, 6, 8, False)], EVENT)
    assert words_of(events) == by_hand(0x8000, 0x8123, 0x6456, 0x0007, 0x2805, 0x2006, 0x6457, 0x0008, 0x2006)


def test_five_events_of_a_window_are_a_base_and_a_whole_triple():
    """Columns 64, 65, 75, 76 and 95 of the window from 64: bits 0, 1, 11; 12; 31."""
    events = group(0x1001, 3, True, [64, 65, 75, 76, 95])
    assert words_of(events) == by_hand(0x8000, 0x8001, 0x6001, 0x0003, 0x3840, 0x4803, 0x4001, 0x5080)
    assert words_of(group(0, 3, False, range(96, 128))) == by_hand(0x8000, 0x6000, 3, 0x3060, 0x4FFF, 0x4FFF, 0x50FF)


@pytest.mark.parametrize(
    ("columns", "kinds"),
    [
        ([64, 65, 66, 67], "2222"),  # four words are not fewer than four
        ([64, 66, 65, 67, 68], "22222"),  # the order would be lost
        ([64, 64, 65, 66, 67], "22222"),  # one bit for two events
        ([60, 61, 62, 63, 64, 65, 66, 67, 68], "22223445"),  # two windows
        ([1, 0, 1, 2, 3, 4], "23445"),
    ],
)
def test_vectors_are_used_where_they_are_shorter_and_keep_the_order(columns, kinds):
    events = group(0, 0, True, columns)
    assert "".join(word[2] for word in words_of(events)[3:]) == kinds
    np.testing.assert_array_equal(by_evt3(Evt3Encoder().encode(events)), events)


def test_no_vector_passes_the_last_column_of_the_sensor():
    """OpenEB drops one that does, even where the bits beyond are not set."""
    events = group(0, 0, True, range(320, 346))
    assert "0x3940" in words_of(events, width=352)
    assert [word[2] for word in words_of(events, width=346)[3:]] == ["2"] * 26


@given(streams(), st.integers(1, 50))
def test_another_decoder_reads_the_same_events(events, piece):
    encoder = Evt3Encoder()
    data = b"".join(encoder.encode(events[k : k + piece]) for k in range(0, len(events), piece))
    np.testing.assert_array_equal(by_evt3(data), events)
    np.testing.assert_array_equal(Evt3Decoder().decode(data)[0], events)


@given(streams(long_steps_us, max_groups=4))
@example(group(WRAP_US // 2, 0, True, range(5)))
@example(np.concatenate([group(t, 0, True, range(5)) for t in (WRAP_US - 1, WRAP_US, 2 * WRAP_US, 3 * WRAP_US + 1)]))
def test_silences_of_hours_lose_no_wrap(events):
    data = Evt3Encoder().encode(events)
    high = np.frombuffer(data, "<u2")
    high = high[high >> 12 == 8].astype(int) & 0xFFF
    steps = np.diff(high) % 4096
    assert (steps < 2048).all()
    assert all(before == 4095 and after == 0 for before, after in pairwise(high) if after < before)
    np.testing.assert_array_equal(by_evt3(data), events)


@given(streams(max_groups=6), st.integers(1, 40))
def test_messages_that_stand_alone_are_read_in_a_row_and_from_any_of_them(events, piece):
    encoder = Evt3Encoder(standalone=True)
    parts = [events[k : k + piece] for k in range(0, len(events), piece)]
    messages = [encoder.encode(part) for part in parts]
    np.testing.assert_array_equal(by_evt3(b"".join(messages)), events)
    for message, part in zip(messages, parts, strict=True):
        assert message[1] >> 4 == 8
        read = Evt3Decoder().decode(message)[0]
        np.testing.assert_array_equal(read[["x", "y", "on"]], part[["x", "y", "on"]])
        assert ((read["t"] - part["t"]) % WRAP_US == 0).all()


@given(st.lists(st.tuples(st.booleans(), st.integers(0, WRAP_US)), max_size=20), st.booleans())
def test_after_each_step_of_a_silence_events_have_their_time(turns, standalone):
    encoder, data, expected, t = Evt3Encoder(standalone=standalone), b"", [], 0
    for is_silent, step_us in turns:
        t += step_us
        if is_silent:
            data += encoder.advance(t)
        else:
            expected.append(group(t, 5, True, [1]))
            data += encoder.encode(expected[-1])
    np.testing.assert_array_equal(by_evt3(data), np.concatenate([np.zeros(0, EVENT), *expected]))


def test_a_silence_is_told_by_high_parts_in_steps_below_half_a_wrap():
    encoder = Evt3Encoder()
    assert encoder.advance(0) == bytes.fromhex("0080")  # a stream begins with high part 0
    encoder.encode(group(10, 0, True, [0]))
    assert encoder.advance(4095) == b""
    assert encoder.advance(4096) == bytes.fromhex("0180")
    assert encoder.advance(4096) == encoder.advance(0) == b""
    words = [int(word) & 0xFFF for word in np.frombuffer(encoder.advance(WRAP_US), "<u2")]
    assert words == [1024, 2048, 3072, 4095, 0]
    with pytest.raises(ValueError, match="goes back"):
        encoder.encode(group(WRAP_US - 1, 0, True, [0]))


def test_more_words_than_the_room_holds_go_on_without_a_seam():
    """Room is 32 768 words; vectors and singles lie at its end."""
    rng = np.random.default_rng(5)
    events = np.concatenate([group(3 * k, k % 720, k % 3 > 0, 32 + np.arange(k % 9)) for k in range(22_000)])
    edges = make_edges(np.sort(rng.integers(0, 66_000, 500)), EdgeKind.PULSE)
    data = Evt3Encoder().encode(events, edges)
    assert len(data) > 3 * 65_536
    np.testing.assert_array_equal(by_evt3(data), events)
    read = Evt3Decoder().decode(data)[1]
    np.testing.assert_array_equal(read["t"], np.repeat(edges["t"], 2))


def test_triggers_lie_before_the_events_of_their_time():
    edges = np.array([(10, EdgeKind.RISING, 0, 0), (15, EdgeKind.FALLING, 3, 0), (30, EdgeKind.PULSE, 0, 0)], EDGE)
    events = np.concatenate([group(t, 2, True, [t]) for t in (5, 15, 25)])
    assert words_of(events, edges) == by_hand(
        0x8000, 0x6005, 2, 0x2805, 0x600A, 0xA001, 0x600F, 0xA300, 0x280F, 0x6019, 0x2819, 0x601E, 0xA001, 0xA000
    )  # fmt: skip
    data = Evt3Encoder().encode(events, edges)
    read, triggers = Evt3Decoder().decode(data)
    np.testing.assert_array_equal(read, events)
    assert triggers["t"].tolist() == [10, 15, 30, 30]
    assert triggers["channel"].tolist() == [0, 3, 0, 0]
    assert triggers["kind"].tolist() == [EdgeKind.RISING, EdgeKind.FALLING, EdgeKind.RISING, EdgeKind.FALLING]


@given(streams(max_groups=5), st.lists(st.integers(0, 10 * WRAP_US), max_size=20))
def test_triggers_among_events_are_read_by_others(events, times):
    edges = make_edges(sorted(times), EdgeKind.RISING)
    data = evt3_header(SIZE) + Evt3Encoder().encode(events, edges)
    np.testing.assert_array_equal(by_evt3(data[len(evt3_header(SIZE)) :]), events)
    triggers = Evt3Decoder().decode(data[len(evt3_header(SIZE)) :])[1]
    np.testing.assert_array_equal(triggers, edges)


@pytest.mark.parametrize(
    ("times", "x", "y", "message"),
    [
        ([5, 3], 0, 0, "goes back"),
        ([1 << 63], 0, 0, "goes back"),
        ([1 << 38], 0, 0, "38 hours"),
        ([1], 2048, 0, "columns and rows"),
        ([1], 0, 2048, "columns and rows"),
    ],
)
def test_what_the_words_cannot_tell_is_refused_and_changes_nothing(times, x, y, message):
    encoder, other = Evt3Encoder(), Evt3Encoder()
    encoder.encode(group(1, 4, True, [3]))
    other.encode(group(1, 4, True, [3]))
    bad = np.array([(t, x, y, True) for t in times], EVENT)
    with pytest.raises(ValueError, match=message):
        encoder.encode(bad)
    after = group(2, 4, True, [3])
    assert encoder.encode(after) == other.encode(after)
    with pytest.raises(ValueError, match="38 hours"):
        encoder.advance(1 << 38)


def test_read_only_events_and_views_with_gaps_are_encoded():
    events = group(7, 4, True, range(40, 60))
    expected = Evt3Encoder().encode(events[::2].copy())
    fixed = np.frombuffer(events[::2].tobytes(), EVENT)
    assert Evt3Encoder().encode(events[::2]) == Evt3Encoder().encode(fixed) == expected


@pytest.mark.parametrize("origin_us", [0, 123_456_789])
def test_pieces_of_a_size_hold_as_much_as_fits_and_together_all(origin_us):
    draw = np.random.default_rng(4)
    events = events_at(
        origin_us + np.sort(draw.integers(0, 400, 3000)), x=draw.integers(0, 1280, 3000), y=draw.integers(0, 2, 3000)
    )
    edges = np.array([(origin_us + t, EdgeKind.RISING, 0, 0) for t in (0, 77, 399)], EDGE)
    encoder, decoder = Evt3Encoder(standalone=True, origin_us=origin_us), Evt3Decoder()
    seen, told, sizes = [], [], []
    for part in encoder.parts(events, edges, 200):
        sizes.append(len(part.words))
        for into, found in zip((seen, told), decoder.decode(part.words), strict=True):
            into.append(found)
        assert (part.events, part.edges) == (sum(map(len, seen)), sum(map(len, told)))
    assert max(sizes) <= 200
    assert min(sizes[:-1]) > 200 - 16 - 8  # at most one turn of the loop is left out
    expected = events.copy()
    expected["t"] -= np.uint64(origin_us)
    assert np.concatenate(seen).tobytes() == expected.tobytes()
    assert np.concatenate(told)["t"].tolist() == [0, 77, 399]
