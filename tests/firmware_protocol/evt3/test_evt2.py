"""EVT2 and EVT2.1 words of events: by hand from the formats' documents, by readers of others, and by our own."""

import numpy as np
import pytest
from evt2_words import by_the_tables
from evt3_streams import streams
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EDGE, EVENT, EdgeKind, make_edges
from firmware_protocol.evt.evt2 import Evt2Decoder, Evt2Encoder

FORMS = ["evt2", "evt21", "evt21-legacy"]
WRAP_US = 1 << 34

forms = st.sampled_from(FORMS)


def group(t, y, on, columns):
    return np.array([(t, x, y, on) for x in columns], EVENT)


EVENTS = np.concatenate([group(0x1234567, 5, True, [64, 65, 95, 96]), group(0x1234568, 6, False, [2, 1])])
EDGES = np.array([(0x1234567, EdgeKind.PULSE, 3, 0)], EDGE)

# Time 0x1234567 is high part 0x48D15 and low part 0x27; x in bits 21..11, y in bits 10..0.
TIME, PULSE = 0x80048D15, [0xA9C00301, 0xA9C00300]
ON = [0x19C00005 | x << 11 for x in (64, 65, 95, 96)]
OFF = [0x0A000006 | x << 11 for x in (2, 1)]
ROWS = [(ON[0], 0x80000003), (ON[3], 1), (0x0A000006, 4), (0x0A000006, 2)]


@pytest.mark.parametrize(
    ("form", "words"),
    [
        ("evt2", [0x80000000, TIME, *PULSE, *ON, *OFF]),
        ("evt21", [0, 0x80000000, 0, TIME, 0, PULSE[0], 0, PULSE[1], *(w for row in ROWS for w in row[::-1])]),
        ("evt21-legacy", [0x80000000, 0, TIME, 0, PULSE[0], 0, PULSE[1], 0, *(w for row in ROWS for w in row)]),
    ],
)
def test_words_are_those_of_the_published_formats(form, words):
    data = Evt2Encoder(form).encode(EVENTS, EDGES)
    assert [hex(word) for word in np.frombuffer(data, "<u4")] == [hex(word) for word in words]


# OpenEB 5.1.1 decoded these octets as two ON events at t = 1 000 000 us, y 100, x 64 and 67.
@pytest.mark.parametrize(
    ("form", "octets"),
    [
        ("evt2", "093d0080 64000210 64180210"),
        ("evt21", "00000000093d0080 0900000064000210"),
        ("evt21-legacy", "093d008000000000 6400021009000000"),
    ],
)
def test_octets_are_those_that_openeb_decodes(form, octets):
    first = {"evt2": 4}.get(form, 8)  # every stream begins with the time zero
    assert Evt2Encoder(form).encode(group(1_000_000, 100, True, [64, 67]))[first:] == bytes.fromhex(octets)


@given(streams(), forms, st.integers(0, 3 * WRAP_US), st.integers(1, 50))
def test_a_reader_that_knows_the_tables_alone_sees_what_was_given(events, form, start_us, piece):
    events["t"] += np.uint64(start_us)
    edges = make_edges(events["t"][::7], EdgeKind.FALLING, channel=31)
    encoder, data = Evt2Encoder(form), b""
    for k in range(0, len(events), piece):
        now = edges[(k + 6) // 7 : (min(k + piece, len(events)) + 6) // 7]
        data += encoder.encode(events[k : k + piece], now)
    seen = by_the_tables(data, form)
    np.testing.assert_array_equal(seen[0], events)
    np.testing.assert_array_equal(seen[1], edges)


@given(streams(max_groups=4), forms, st.integers(0, 1 << 40))
def test_time_in_words_counts_from_an_origin(events, form, origin_us):
    later = events.copy()
    later["t"] += np.uint64(origin_us)
    assert Evt2Encoder(form, origin_us=origin_us).encode(later) == Evt2Encoder(form).encode(events)


@given(st.binary(max_size=400), forms, st.integers(1, 50))
def test_any_bytes_in_any_pieces_mean_the_same_to_both_readers(data, form, piece):
    """Times alone may differ: for ours a time high that goes back by any step is a turn, or a stray one."""
    decoder, (other_events, other_edges) = Evt2Decoder(form), by_the_tables(data, form)
    parts = [decoder.decode(data[k : k + piece]) for k in range(0, len(data) + 1, piece)]
    events, edges = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    np.testing.assert_array_equal(events[["x", "y", "on"]], other_events[["x", "y", "on"]])
    np.testing.assert_array_equal(edges[["kind", "channel"]], other_edges[["kind", "channel"]])


@given(streams(), forms, st.integers(1, 50), st.integers(1, 99))
def test_what_is_encoded_is_decoded_in_pieces_of_any_size(events, form, piece, size):
    edges = make_edges(events["t"][::9], EdgeKind.RISING, channel=6)
    encoder, decoder = Evt2Encoder(form), Evt2Decoder(form)
    data = encoder.encode(events[:piece], edges[: (piece + 8) // 9])
    data += encoder.encode(events[piece:], edges[(piece + 8) // 9 :])
    parts = [decoder.decode(data[k : k + size]) for k in range(0, len(data), size)]
    np.testing.assert_array_equal(np.concatenate([np.zeros(0, EVENT), *(part[0] for part in parts)]), events)
    np.testing.assert_array_equal(np.concatenate([np.zeros(0, EDGE), *(part[1] for part in parts)]), edges)


@given(st.lists(st.tuples(st.booleans(), st.integers(0, WRAP_US)), max_size=12), forms, st.booleans())
def test_silences_of_hours_lose_no_wrap(turns, form, standalone):
    encoder, data, expected, t = Evt2Encoder(form, standalone=standalone), b"", [], 0
    for is_silent, step_us in turns:
        t += step_us
        data += encoder.advance(t) if is_silent else encoder.encode(group(t, 7, True, [1]))
        expected += [] if is_silent else [group(t, 7, True, [1])]
    np.testing.assert_array_equal(Evt2Decoder(form).decode(data)[0], np.concatenate([np.zeros(0, EVENT), *expected]))
    words = np.frombuffer(data, "<u4" if form == "evt2" else "<u8")
    shift = {"evt2": 28, "evt21": 60, "evt21-legacy": 28}[form]
    words = words[(words >> np.uint64(shift) & np.uint64(15)) == 8]
    high = (words >> np.uint64(32 if form == "evt21" else 0) & np.uint64(0xFFFFFFF)).astype(np.int64)
    steps = np.diff(high)
    assert (steps % (1 << 28) < 1 << 27).all()
    assert (high[:-1][steps < 0] == (1 << 28) - 1).all()
    assert (high[1:][steps < 0] == 0).all()


@given(streams(max_groups=5), forms, st.integers(1, 40))
def test_messages_that_stand_alone_begin_with_their_time(events, form, piece):
    encoder = Evt2Encoder(form, standalone=True)
    for k in range(0, len(events), piece):
        read = Evt2Decoder(form).decode(encoder.encode(events[k : k + piece]))[0]
        part = events[k : k + piece]
        np.testing.assert_array_equal(read[["x", "y", "on"]], part[["x", "y", "on"]])
        assert ((read["t"] - part["t"]) % WRAP_US == 0).all()


@pytest.mark.parametrize("form", FORMS)
def test_without_a_time_nothing_is_read(form):
    data = Evt2Encoder(form).encode(EVENTS, EDGES)
    skipped = 8 if form == "evt2" else 16
    events, edges = Evt2Decoder(form).decode(data[skipped:])
    assert len(events) == len(edges) == 0


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("times", "x", "message"), [([5, 3], 0, "goes back"), ([1 << 38], 0, "38 hours"), ([1], 2048, "columns and rows")]
)
def test_what_the_words_cannot_tell_is_refused(form, times, x, message):
    with pytest.raises(ValueError, match=message):
        Evt2Encoder(form).encode(np.array([(t, x, 0, True) for t in times], EVENT))
