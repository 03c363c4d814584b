"""The bytes of event streams: the words of their documents, ends of datagrams, wraps of time, restarts."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EVENT, EdgeKind, empty_edges, make_edges
from firmware_protocol.network_streams.coders import (
    CaerConnectionCoder,
    CaerDatagramCoder,
    DvCoder,
    FaeryLongCoder,
    FaeryShortCoder,
    JaerCoder,
    StreamFacts,
)
from firmware_protocol.network_streams.words import SpifCoder, SpifConnectionCoder
from tests.made_events import steady
from tests.transports.network_streams.stream_readers import (
    CaerDatagrams,
    JaerDecoder,
    caer_events,
    caer_packets,
    long_events,
    short_events,
)

FACTS = StreamFacts((346, 260), "DAVIS346")
NO_EDGES = empty_edges()
DATAGRAM_CODERS = [JaerCoder, CaerDatagramCoder, SpifCoder, FaeryLongCoder, FaeryShortCoder]


def some_events(count, start_us=0, seed=1):
    return steady(count, start_us, seed=seed)


def spif_events(datagram):
    return [
        (word >> 16 & 0x7FFF, word & 0x7FFF, bool(word >> 15 & 1)) for (word,) in struct.iter_unpack("<I", datagram)
    ]


def test_a_packet_of_dv_has_the_words_of_its_layout():
    packet = DvCoder(FACTS).encode(np.array([(5, 1, 2, True), (7, 3, 4, False)], EVENT), NO_EDGES)
    # What dv_processing 2.0.4's own NetworkWriter sent for these two events, but for the size of an empty tail.
    assert packet.hex(" ") == (
        "00 00 00 00 40 00 00 00 3c 00 00 00 10 00 00 00 45 56 54 53 00 00 06 00 08 00 04 00 06 00 00 00 04 00 00 00 "
        "02 00 00 00 05 00 00 00 00 00 00 00 01 00 02 00 01 00 00 00 07 00 00 00 00 00 00 00 03 00 04 00 00 00 00 00"
    )


@pytest.mark.parametrize(("coder", "decode", "last_us"), [
    (JaerCoder, JaerDecoder(), 2**31), (CaerDatagramCoder, CaerDatagrams(), 2**32),
    (FaeryLongCoder, long_events, 2**40), (FaeryShortCoder, short_events, 2**32),
])  # fmt: skip
def test_datagrams_decoded_from_the_documents_are_the_events(coder, decode, last_us):
    events = some_events(1000, last_us - 1000)
    decoded = [event for datagram in coder(FACTS).encode(events, NO_EDGES) for event in decode(datagram.data)]
    assert decoded == events.tolist()


def test_spif_words_are_the_places_and_polarities():
    events = some_events(300)
    decoded = [event for datagram in SpifCoder(FACTS).encode(events, NO_EDGES) for event in spif_events(datagram.data)]
    assert decoded == [(x, y, on) for _, x, y, on in events.tolist()]
    assert spif_events(SpifConnectionCoder(FACTS).encode(events, NO_EDGES)) == decoded


@pytest.mark.parametrize("coder", DATAGRAM_CODERS)
@given(count=st.integers(0, 700))
def test_the_ends_of_datagrams_rise_to_the_number_of_events(coder, count):
    datagrams = list(coder(FACTS).encode(some_events(count), NO_EDGES))
    ends = [datagram.end for datagram in datagrams]
    assert ends == sorted(ends)
    assert ([0] + ends)[-1] == count
    assert all(len(datagram.data) <= 1472 for datagram in datagrams)


def test_caer_packets_carry_edges_and_the_wrap_of_time():
    edges = make_edges([3, 9], [EdgeKind.RISING, EdgeKind.FALLING])
    events = some_events(10, 2**31 - 5)
    data = CaerConnectionCoder(FACTS).encode(events, edges)
    assert caer_events(data) == events.tolist()
    special = [(word >> 1 & 0x7F, t) for kind, _, records in caer_packets(data) if kind == 0 for word, t in records]
    assert special == [(2, 3), (3, 9)]


def test_caer_tells_of_a_clock_that_starts_anew():
    ((kind, wraps, records),) = caer_packets(CaerConnectionCoder(FACTS).restart())
    assert (kind, wraps, records[0][0]) == (0, 0, 1 << 1 | 1)


def test_jaer_edges_end_no_event_too_early():
    edges = make_edges(np.arange(300) * 2, EdgeKind.RISING)
    events, decode = some_events(600), JaerDecoder()
    seen = 0
    for datagram in JaerCoder(FACTS).encode(events, edges):
        seen += len(decode(datagram.data))
        assert datagram.end == seen
    assert seen == 600
