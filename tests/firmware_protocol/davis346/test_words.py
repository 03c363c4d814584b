"""The DAVIS word encoder: golden words, the rules drivers depend on, and hostile events."""

import numpy as np
import pytest
from davis_host import events_of, steady
from davis_strategies import cut, streams
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.davis346.decoder import Decoder
from firmware_protocol.davis346.words import WordEncoder
from firmware_protocol.fx3.words import MAX_STEPS, SINGLE_WRAPS, WordState, wrap_words

CUTS = st.lists(st.integers(0, 200), max_size=5)


def words_of(events, **options):
    return WordEncoder(**options).encode(events).words.tolist()


def reference_words(events):
    """The rules of the stream one event at a time, the slow and obvious way."""
    words, time, row = [], 0, None
    for t, x, y, on in events.tolist():
        while t >> 15 > time >> 15:
            words.append(0x7001)
            time = ((time >> 15) + 1) << 15
        if t != time:
            words.append(0x8000 | t & 0x7FFF)
            time = t
        if y != row:
            words.append(0x1000 | y)
            row = y
        words.append((0x3000 if on else 0x2000) | x)
    return words


def test_golden_words():
    events = events_of((5, 3, 7, True), (5, 4, 7, False), (6, 345, 259, True), (6, 0, 0, False))
    assert words_of(events) == [0x8005, 0x1007, 0x3003, 0x2004, 0x8006, 0x1103, 0x3159, 0x1000, 0x2000]


def test_ends_are_one_past_the_last_word_of_each_event():
    events = events_of((5, 3, 7, True), (5, 4, 7, False), (70000, 1, 1, True))
    assert WordEncoder().encode(events).ends.tolist() == [3, 4, 9]


def test_turned_layout_sends_x_as_row_and_y_as_column():
    assert words_of(events_of((1, 345, 259, True)), size=(346, 260), turned=True) == [0x8001, 0x1159, 0x3103]


def test_device_time_counts_from_the_epoch():
    assert WordEncoder().encode(events_of((1_000_007, 1, 2, True)), 1_000_000).words.tolist() == [
        0x8007,
        0x1002,
        0x3001,
    ]


@pytest.mark.parametrize("n", [1, 16384, 16385, 40000])
@pytest.mark.parametrize("step_us", [0, 1, 50])
def test_blocks_leave_no_seam(n, step_us):
    events = steady(n, step_us=step_us)
    assert words_of(events) == reference_words(events)


@given(streams(), CUTS)
def test_words_are_those_of_the_rules_however_the_stream_is_cut(events, cuts):
    encoder = WordEncoder((346, 260))
    words = [word for part in cut(events, cuts) for word in encoder.encode(part).words.tolist()]
    assert words == reference_words(events)


@given(streams(), CUTS, st.booleans())
def test_decoding_gives_the_events_back(events, cuts, turned):
    data = WordEncoder((346, 260), turned).encode(events).words.tobytes()
    decoder = Decoder((346, 260), turned)
    assert np.array_equal(np.concatenate([decoder.feed(part).events for part in cut(data, cuts)]), events)
    assert decoder.faults.total == decoder.faults.not_interpreted == 0


@given(streams(), st.integers(0, 200))
def test_state_after_words_is_what_the_encoder_remembers(events, upto):
    encoder = WordEncoder()
    words = encoder.encode(events).words
    assert WordState().after(words) == encoder.state
    assert WordState().after(words[:upto]).after(words[upto:]) == encoder.state


def test_wraps_while_idle_come_one_by_one():
    encoder = WordEncoder()
    assert encoder.advance(32767).tolist() == []
    assert encoder.advance(32768).tolist() == [0x7001]
    assert encoder.advance(32768).tolist() == []
    assert encoder.advance(4 * 32768 + 5).tolist() == [0x7001] * 3
    assert encoder.encode(events_of((4 * 32768 + 5, 1, 1, True))).words.tolist() == [0x8005, 0x1001, 0x3001]


def test_wraps_that_do_not_fit_become_words_of_many_steps_or_wait():
    encoder = WordEncoder()
    assert encoder.advance(10 * 32768, room=0).tolist() == []
    assert encoder.advance(10 * 32768, room=9).tolist() == [0x700A]
    assert encoder.state.time_us == 10 * 32768


@given(st.integers(0, 50_000), st.integers(0, 6000))
def test_wrap_words_add_up_and_stay_within_their_room(steps, room):
    words = wrap_words(steps, room)
    if words is None:
        assert room < -(-steps // MAX_STEPS)
    else:
        assert len(words) <= room
        assert int((words & 0xFFF).sum(dtype=np.int64)) == steps
        assert len(words) == steps or steps > min(room, SINGLE_WRAPS)


def test_a_very_long_gap_takes_few_words():
    events = events_of((0, 1, 1, True), (10**11, 1, 1, True))
    encoded = WordEncoder().encode(events)
    assert len(encoded.words) < 10_000
    assert np.array_equal(Decoder().feed(encoded.words.tobytes()).events, events)


def test_reset_starts_time_and_row_anew():
    encoder = WordEncoder()
    encoder.encode(events_of((50_000, 1, 9, True)))
    assert encoder.reset().tolist() == [1]
    assert encoder.encode(events_of((0, 2, 9, True))).words.tolist() == [0x1009, 0x3002]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(40_005, 1, 1, True), (40_004, 1, 1, True)], "sorted"),
        ([(40_005, 346, 1, True)], "outside the 346 x 260 array"),
        ([(40_005, 1, 260, True)], "outside the 346 x 260 array"),
        ([(2**62, 1, 1, True)], "too long"),
        ([(2**64 - 1, 1, 1, True)], "sorted"),
    ],
)
def test_bad_events_are_refused_and_leave_the_encoder_as_it_was(rows, message):
    """The bad ones come after a block of good ones, which must not have left a trace."""
    encoder = WordEncoder((346, 260))
    start = encoder.encode(steady(20_000)).words
    before = encoder.state
    good = steady(20_000, start_us=20_000)
    with pytest.raises(ValueError, match=message):
        encoder.encode(np.concatenate([good, events_of(*rows)]))
    assert encoder.state == before
    words = np.concatenate([start, encoder.encode(good).words])
    assert np.array_equal(Decoder().feed(words.tobytes()).events[20_000:], good)


def test_events_before_what_the_stream_has_reached_are_refused():
    encoder = WordEncoder()
    encoder.advance(40_000)
    with pytest.raises(ValueError, match="after device time"):
        encoder.encode(events_of((32_767, 1, 1, True)))


@pytest.mark.parametrize("size", [(4097, 10), (10, 4097), (0, 10)])
def test_an_array_beyond_twelve_bits_is_refused(size):
    with pytest.raises(ValueError, match="12-bit"):
        WordEncoder(size)


def test_the_largest_array_fits():
    assert words_of(events_of((1, 4095, 4095, True), (1, 0, 4095, False))) == [0x8001, 0x1FFF, 0x3FFF, 0x2000]
