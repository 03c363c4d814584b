"""Words of sensors as streams: every client, every datagram and every receiver on a line finds its way."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EDGE, EVENT, EdgeKind, empty_edges, empty_events, make_edges
from firmware_protocol.evt.evt2 import Evt2Decoder
from firmware_protocol.evt.evt3 import Evt3Decoder
from firmware_protocol.network_streams.coders import StreamFacts
from firmware_protocol.network_streams.words import WORD_CONNECTION_CODERS, WORD_DATAGRAM_CODERS, repeat_us
from tests.made_events import events_at

WRAP_US = {"evt2": 1 << 34, "evt21": 1 << 34, "evt3": 1 << 24}
HIGH_SHIFT = {"evt2": ("<u4", 28), "evt21": ("<u8", 60), "evt3": ("<u2", 12)}
TIME_HIGH = 8
NO_EVENTS, NO_EDGES = empty_events(), empty_edges()

forms = st.sampled_from(list(WRAP_US))
gaps_us = st.lists(st.one_of(st.integers(0, 20), st.integers(0, 10_000), st.integers(0, 1 << 31)), max_size=30)
silences_us = st.one_of(st.integers(0, 9), st.integers(0, 1 << 20))
pieces = st.lists(st.tuples(gaps_us, silences_us), min_size=1, max_size=5)


def facts_of(form, **more):
    return StreamFacts((346, 260), "CAM", form=form, **more)


def decoder_of(form):
    return Evt3Decoder() if form == "evt3" else Evt2Decoder(form)


def first_kind(form, data):
    dtype, shift = HIGH_SHIFT[form]
    return int(np.frombuffer(data, dtype, 1)[0]) >> shift


def batches_of(pieces):
    """Return batches of (events, edges, time reached), none before the earlier ones; a batch may be a silence."""
    t, batches = 0, []
    for gaps, silence_us in pieces:
        times = t + np.cumsum(np.array(gaps, np.int64)) if gaps else np.zeros(0, np.int64)
        events = events_at(times, x=np.arange(len(times)) * 5 % 346, y=times % 3)
        edges = make_edges(times[::4], EdgeKind.RISING, channel=2)
        t = (int(times[-1]) if len(times) else t) + silence_us
        batches.append((events, edges, t))
        t += 1
    return batches


def same_but_for_turns(seen, given, form):
    """Compare all fields; the time may differ by one number of turns of the high part."""
    names = [name for name in given.dtype.names if name not in ("t", "seq")]
    np.testing.assert_array_equal(seen[names], given[names])
    difference = seen["t"].astype(np.int64) - given["t"].astype(np.int64)
    assert (difference % WRAP_US[form] == 0).all()


@given(forms, pieces, st.integers(0, 4))
def test_a_client_that_joins_at_any_packet_reads_all_that_follows(form, pieces, joined):
    coder, data, batches = WORD_CONNECTION_CODERS[form](facts_of(form)), b"", batches_of(pieces)
    assert coder.greeting == b""
    joined = min(joined, len(batches) - 1)
    for k, (events, edges, now_us) in enumerate(batches):
        packet = coder.encode(events, edges)
        silence = coder.advance(now_us)
        if packet and k == joined:
            assert first_kind(form, packet) == TIME_HIGH
        data += packet + silence if k >= joined else b""
    seen, edges = decoder_of(form).decode(data)
    same_but_for_turns(seen, np.concatenate([batch[0] for batch in batches[joined:]]), form)
    same_but_for_turns(edges, np.concatenate([batch[1] for batch in batches[joined:]]), form)


@given(forms, pieces)
def test_each_datagram_is_read_alone(form, pieces):
    coder = WORD_DATAGRAM_CODERS[form](facts_of(form))
    for events, edges, _ in batches_of(pieces):
        seen, told, before = [NO_EVENTS], [NO_EDGES], 0
        for datagram in coder.encode(events, edges):
            assert len(datagram.data) <= 1472
            assert first_kind(form, datagram.data) == TIME_HIGH
            parts = decoder_of(form).decode(datagram.data)
            seen.append(parts[0])
            told.append(parts[1])
            assert len(parts[0]) == datagram.end - before
            before = datagram.end
        same_but_for_turns(np.concatenate(seen), events, form)
        same_but_for_turns(np.concatenate(told), edges, form)


@pytest.mark.parametrize("form", list(WRAP_US))
def test_datagrams_of_one_moment_begin_with_its_time_and_row(form):
    coder, events = WORD_DATAGRAM_CODERS[form](facts_of(form)), np.zeros(3000, EVENT)
    events["t"], events["x"], events["y"] = 5000, np.arange(3000) * 40 % 346, 9
    parts = [decoder_of(form).decode(datagram.data)[0] for datagram in coder.encode(events, NO_EDGES)]
    assert len(parts) > 3
    np.testing.assert_array_equal(np.concatenate(parts), events)


@given(forms, st.integers(0, 1 << 40), st.integers(0, 1 << 20))
def test_an_edge_that_comes_late_gets_the_present_time(form, now_us, late_us):
    coder = WORD_CONNECTION_CODERS[form](facts_of(form))
    data = coder.advance(now_us)
    edge = np.array([(max(0, now_us - late_us), EdgeKind.FALLING, 1, 0)], EDGE)
    data += coder.encode(NO_EVENTS, edge)
    (seen,) = decoder_of(form).decode(data)[1]
    assert (int(seen["t"]) - now_us) % WRAP_US[form] == 0


@pytest.mark.parametrize("form", list(WRAP_US))
def test_after_a_restart_of_the_clock_the_time_begins_again(form):
    for coders in (WORD_CONNECTION_CODERS, WORD_DATAGRAM_CODERS):
        coder = coders[form](facts_of(form))

        def coded(t, coder=coder):
            made = coder.encode(np.array([(t, 1, 2, True)], EVENT), NO_EDGES)
            return made if isinstance(made, bytes) else b"".join(datagram.data for datagram in made)

        coded(5_000_000)
        assert b"".join(coder.restart()) == b"" if coders is WORD_DATAGRAM_CODERS else coder.restart() == b""
        assert decoder_of(form).decode(coded(7))[0]["t"].tolist() == [7]


@pytest.mark.parametrize("form", list(WRAP_US))
def test_a_silence_of_years_does_not_end_a_stream(form):
    year_us = 31_557_600_000_000
    for coder in (coders[form](facts_of(form)) for coders in (WORD_CONNECTION_CODERS, WORD_DATAGRAM_CODERS)):
        for t in (0, year_us, 3 * year_us):
            made = coder.encode(np.array([(t, 1, 2, True)], EVENT), NO_EDGES)
            data = made if isinstance(made, bytes) else b"".join(datagram.data for datagram in made)
            (event,) = decoder_of(form).decode(data)[0]
            assert (int(event["t"]) - t) % WRAP_US[form] == 0


@pytest.mark.parametrize(("form", "bytes_per_s", "period_us"), [
    ("evt3", 1_200_000, 16), ("evt3", 92_160, 256), ("evt3", 11_520, 2048), ("evt2", 1_200_000, 32),
    ("evt2", 5_000_000, 16), ("evt21", 92_160, 1024), ("evt3", 5, 1 << 22), ("spif", 92_160, 0),
])  # fmt: skip
def test_repeated_times_take_an_eighth_of_a_line_at_most(form, bytes_per_s, period_us):
    assert repeat_us(form, bytes_per_s) == period_us


@given(st.sampled_from(list(WRAP_US)), st.integers(1, 2000), st.integers(0, 1 << 30))
def test_a_receiver_on_a_line_finds_its_way_within_16_us(form, count, where):
    """Events are 5 us apart: whoever joins at any word misses at most those of the period that has begun."""
    coder = WORD_CONNECTION_CODERS[form](dataclasses.replace(facts_of(form), repeat_us=16))
    events = events_at(1000 + 5 * np.arange(count), x=np.arange(count) % 346, y=3)
    data = b"".join(coder.encode(part, NO_EDGES) for part in np.array_split(events, 1 + count // 7))
    octets = np.dtype(HIGH_SHIFT[form][0]).itemsize
    skipped = where % (len(data) // octets) * octets
    before = len(decoder_of(form).decode(data[:skipped])[0])
    seen = decoder_of(form).decode(data[skipped:])[0]
    assert len(seen) >= count - before - 4
    same_but_for_turns(seen, events[count - len(seen) :], form)
