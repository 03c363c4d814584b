"""The DAVIS decoder: libcaer's semantics word by word, any bytes, any split."""

import numpy as np
import pytest
from davis_strategies import cut
from hypothesis import example, given
from hypothesis import strategies as st

from firmware_protocol.davis346 import decoder as decoder_module
from firmware_protocol.davis346.decoder import Decoder
from firmware_protocol.fx3.decoded import WordFaults

WORDS = st.one_of(
    st.integers(0, 0xFFFF),
    st.sampled_from(
        [0x0000, 0x0001, 0x0001, 0x7001, 0x7000, 0x7FFF, 0x8000, 0x8001, 0xFFFF, 0x1103, 0x1104, 0x2159, 0x315A]
    ),
    st.builds(lambda kind, low: kind << 12 | low, st.integers(1, 3), st.integers(0, 400)),
)


def decode(words, size=(346, 260), turned=False):
    decoder = Decoder(size, turned)
    return decoder, decoder.feed(np.array(words, "<u2").tobytes())


def rows(events):
    return [tuple(event) for event in events.tolist()]


class Plain:
    """libcaer's parser, one word at a time (davis.c, timestamps.h of libcaer 3.3)."""

    def __init__(self, columns=346, rows=260):
        self.columns, self.rows = columns, rows
        self.wrap = self.time = self.row = 0
        self.events, self.specials, self.faults = [], [], dict.fromkeys(WordFaults.__dataclass_fields__, 0)

    def read(self, words):
        for word in words:
            kind, data = word >> 12, word & 0xFFF
            if kind & 8:
                self.move(self.wrap + (word & 0x7FFF))
            elif kind == 0:
                self.special(data)
            elif kind == 1:
                self.row, bad = (data, 0) if data < self.rows else (self.row, 1)
                self.faults["row_outside"] += bad
            elif kind in (2, 3):
                self.column(data, kind == 3)
            elif kind == 7:
                self.wrap += data * 32768
                self.move(self.wrap)
            else:
                known = kind == 4 or (kind == 5 and data >> 8 <= 3) or (kind == 6 and data >> 10 == 0)
                self.faults["not_interpreted" if known else "unknown_misc"] += 1
        return self

    def move(self, time):
        self.faults["time_not_increasing"] += time <= self.time
        self.time = time

    def special(self, code):
        if code == 1:
            self.wrap = self.time = 0
        self.faults["unknown_special"] += not (1 <= code <= 17 and code != 6)
        self.specials.append((self.time, code, len(self.events)))

    def column(self, address, on):
        if address < self.columns:
            self.events.append((self.time, address, self.row, on))
        else:
            self.faults["column_outside"] += 1


def test_reset_sets_time_to_zero_and_is_reported_between_events():
    _, decoded = decode([0x7001, 0x8005, 0x1002, 0x3001, 0x3002, 0x0001, 0x3003, 0x8001, 0x3004, 0x0001])
    assert rows(decoded.events) == [(32773, 1, 2, True), (32773, 2, 2, True), (0, 3, 2, True), (1, 4, 2, True)]
    assert decoded.resets.tolist() == [2, 4]


def test_time_beyond_32_bits():
    decoder, _ = decode([0x7FFF] * 40)
    assert decoder.time_us == 40 * 4095 * 32768 > 2**32


@given(st.lists(WORDS, max_size=120))
@example([0x7001, 0x7001, 0x0001, 0x7001, 0x8001, 0x2001])
def test_any_words_mean_what_the_plain_parser_says(words):
    plain = Plain().read(words)
    decoder, decoded = decode(words)
    assert rows(decoded.events) == plain.events
    assert decoded.specials[["t", "code", "index"]].tolist() == plain.specials
    assert decoder.faults == WordFaults(**plain.faults)
    assert decoder.time_us == plain.time


@given(st.binary(max_size=300), st.lists(st.integers(0, 300), max_size=8))
def test_any_bytes_in_any_pieces_decode_alike(data, cuts):
    whole, pieces = Decoder(), Decoder()
    once = whole.feed(data)
    parts = [pieces.feed(part) for part in cut(data, cuts)]
    assert np.array_equal(np.concatenate([p.events for p in parts]), once.events)
    assert [(s["t"], s["code"]) for p in parts for s in p.specials] == [(s["t"], s["code"]) for s in once.specials]
    assert pieces.faults == whole.faults
    assert pieces.time_us == whole.time_us


@pytest.mark.parametrize("seed", range(3))
def test_blocks_leave_no_seam(seed, monkeypatch):
    data = np.random.default_rng(seed).integers(0, 256, 20_000, np.uint8).tobytes()
    whole = Decoder().feed(data)
    monkeypatch.setattr(decoder_module, "_BLOCK_WORDS", 97)
    pieces = Decoder().feed(data)
    assert len(whole.events) > 50
    assert np.array_equal(pieces.events, whole.events)
    assert np.array_equal(pieces.specials, whole.specials)
