"""Times that are repeated in periods, and streams that begin late: a receiver that joins at any word finds its way."""

import numpy as np
import pytest
from evt2_words import by_the_tables
from evt3_streams import by_evt3, streams
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EVENT, EdgeKind, make_edges
from firmware_protocol.evt.evt2 import Evt2Decoder, Evt2Encoder
from firmware_protocol.evt.evt3 import Evt3Decoder, Evt3Encoder
from tests.made_events import events_at

FORMS = {"evt2": (4, 1 << 34), "evt21": (8, 1 << 34), "evt21-legacy": (8, 1 << 34), "evt3": (2, 1 << 24)}
short_steps_us = st.one_of(st.just(0), st.integers(0, 40), st.integers(0, 3000))
periods_us = st.sampled_from([16, 64, 1024, 8192])


def encoder_of(form, **settings):
    return Evt3Encoder(**settings) if form == "evt3" else Evt2Encoder(form, **settings)


def decoder_of(form):
    return Evt3Decoder() if form == "evt3" else Evt2Decoder(form)


def edges_among(events):
    return make_edges(events["t"][::7], EdgeKind.FALLING, channel=3)


@given(streams(short_steps_us), st.sampled_from(list(FORMS)), periods_us)
def test_other_readers_see_the_same_events_and_edges(events, form, period_us):
    edges = edges_among(events)
    data = encoder_of(form, repeat_us=period_us).encode(events, edges)
    if form == "evt3":
        np.testing.assert_array_equal(by_evt3(data), events)
        seen = decoder_of(form).decode(data)
    else:
        seen = by_the_tables(data, form)
        np.testing.assert_array_equal(seen[0], events)
    np.testing.assert_array_equal(seen[1], edges)


@given(
    st.lists(st.tuples(st.booleans(), st.integers(0, 700), st.integers(0, 40)), min_size=1, max_size=30),
    st.sampled_from(list(FORMS)), periods_us, st.integers(0, 1 << 40),
)  # fmt: skip
def test_who_joins_at_any_word_reads_all_after_the_next_period(turns, form, period_us, start_us):
    encoder, t, data, parts = encoder_of(form, repeat_us=period_us), start_us, b"", []
    encoder.begin(start_us)
    for silent, step_us, count in turns:
        t += step_us
        if silent:
            data += encoder.advance(t)
            continue
        part = events_at(t + np.arange(count) // 3, x=np.arange(count) * 7 % 300, y=5)
        data += encoder.encode(part)
        parts.append(part)
        t = int(part["t"][-1]) if count else t
    events, (octets, wrap_us) = np.concatenate([np.zeros(0, EVENT), *parts]), FORMS[form]
    for skipped in range(0, len(data), max(1, len(data) // octets // 20) * octets):
        before = len(decoder_of(form).decode(data[:skipped])[0])
        joined = decoder_of(form).decode(data[skipped:])[0]
        later = events["t"] // period_us > (events["t"][before] if before < len(events) else t) // period_us
        expected = events[later]
        seen = joined[len(joined) - len(expected) :]
        assert len(seen) == len(expected)
        np.testing.assert_array_equal(seen[["x", "y", "on"]], expected[["x", "y", "on"]])
        difference = seen["t"].astype(np.int64) - expected["t"].astype(np.int64)
        assert (difference % wrap_us == 0).all()
        assert len(np.unique(difference)) <= 1


@pytest.mark.parametrize("form", list(FORMS))
def test_a_silence_has_a_time_in_each_period(form):
    octets, _ = FORMS[form]
    encoder = encoder_of(form, repeat_us=16)
    encoder.begin(5000)
    assert encoder.advance(5000 - 5000 % 16 + 15) == b""
    assert len(encoder.advance(5000 + 16 * 20)) == 20 * octets
    assert encoder.advance(5000 + 16 * 20) == b""


def test_a_period_of_silence_repeats_the_word_by_hand():
    """High part 1 is 4096 us on; an event after the silence has its time and row again."""
    encoder = Evt3Encoder(repeat_us=16)
    first = encoder.encode(np.array([(4096, 1, 7, True), (4100, 2, 7, True)], EVENT))
    second = encoder.advance(4096 + 32) + encoder.encode(np.array([(4130, 3, 7, True)], EVENT))
    words = [f"{word:04X}" for word in np.frombuffer(first + second, "<u2")]
    assert words == ["8000", "8001", "6000", "0007", "2801", "6004", "2802", "8001", "8001", "6022", "0007", "2803"]


@pytest.mark.parametrize("form", list(FORMS))
@pytest.mark.parametrize("start_us", [0, 1, 4095, 4096, 1 << 24, (1 << 34) - 1, 1 << 34, 1 << 50])
def test_a_stream_that_begins_late_has_its_high_part_first(form, start_us):
    octets, wrap_us = FORMS[form]
    encoder = encoder_of(form)
    encoder.begin(start_us)
    data = encoder.encode(np.array([(start_us, 1, 2, True)], EVENT))
    assert len(data) <= 4 * octets
    (event,) = decoder_of(form).decode(data)[0]
    assert (int(event["t"]) - start_us) % wrap_us == 0
