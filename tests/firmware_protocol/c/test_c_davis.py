"""DAVIS words in C: what the Python decoder makes of them, fault by fault."""

import numpy as np
from davis_strategies import streams
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.davis346.decoder import Decoder
from firmware_protocol.davis346.words import WordEncoder
from firmware_protocol.events import EdgeKind
from firmware_protocol.fx3.words import Special

KINDS = {
    Special.INPUT_RISING: EdgeKind.RISING,
    Special.INPUT_FALLING: EdgeKind.FALLING,
    Special.INPUT_PULSE: EdgeKind.PULSE,
}
FAULTS = ("row_outside", "column_outside", "time_not_increasing", "unknown_special", "unknown_misc", "not_interpreted")
WORDS = st.one_of(
    st.integers(0, 0xFFFF),
    st.sampled_from([0, 1, 2, 3, 4, 6, 17, 18, 0x7001, 0x7000, 0x7FFF, 0x8000, 0xFFFF, 0x1103, 0x1104, 0x2159, 0x315A]),
    st.builds(lambda kind, low: kind << 12 | low, st.integers(1, 3), st.integers(0, 400)),
)


def same_as_python(library, data, turned=False, piece=1 << 20):
    python = Decoder(turned=turned)
    decoded = python.feed(data)
    reply = library("d", data, flags=turned, piece=piece)
    assert np.array_equal(reply.events, decoded.events)
    edges = [(int(s["t"]), KINDS[s["code"]]) for s in decoded.specials if s["code"] in KINDS]
    assert [(int(e["t"]), int(e["kind"])) for e in reply.edges] == edges
    faults = [getattr(python.faults, name) for name in FAULTS]
    time = [python.time_us & 0xFFFFFFFF, python.time_us >> 32]
    assert reply.counters == [len(decoded.events), len(edges), len(decoded.resets), *faults, *time]
    return reply


@given(st.lists(WORDS, max_size=150), st.booleans(), st.integers(1, 7), st.booleans())
def test_any_words_mean_the_same(library, words, turned, piece, odd):
    same_as_python(library, np.array(words, "<u2").tobytes() + b"\x31" * odd, turned, piece)


@given(streams(), st.integers(1, 9))
def test_encoded_events_come_back(library, events, piece):
    encoded = WordEncoder((346, 260)).encode(events)
    assert np.array_equal(same_as_python(library, encoded.words.tobytes(), piece=piece).events, events)
