"""Bytes that nobody meant: damaged, cut, invented. No crash, no event outside the array, nothing wrong accepted."""

import binascii
import itertools
import json

import numpy as np
import pytest
import slow_decoder
from block_strategies import TICKS, stream
from hypothesis import given
from hypothesis import strategies as st
from make_vectors import FOLDER, changed

from firmware_protocol.telemetry.layout import BlockError, Header, Mode, Polarity, crc8
from firmware_protocol.telemetry.reading import decode_block
from firmware_protocol.telemetry.writing import BlockEncoder

GOOD = [bytes.fromhex(vector["hex"]) for vector in json.loads((FOLDER / "blocks.json").read_text())]


def decoded(data):
    """The records that both decoders agree on, or None if they refuse."""
    try:
        block = decode_block(data, 2**32)
    except BlockError:
        block = None
    try:
        _, slow = slow_decoder.decode(data, 2**32)
    except slow_decoder.Refused:
        slow = None
    if block is None:
        assert slow is None
        return None
    if block.header.mode != Mode.EDGE:
        check(block)
    records = (block.events if block.header.mode != Mode.EDGE else block.edges).tolist()
    assert records == slow
    return records


def check(block):
    """What holds for any block that is accepted."""
    events, (width, height) = block.events, block.header.size
    assert len(events) == block.header.count
    assert (events["x"] < width).all()
    assert (events["y"] < height).all()
    t = events["t"].astype(np.int64)
    place = events["y"].astype(np.int64) * width + events["x"]
    assert (np.diff(t) >= 0).all()
    assert (np.diff(place)[np.diff(t) == 0] >= 0).all()


@given(st.binary(max_size=80))
def test_any_bytes_are_refused_or_sound(data):
    decoded(data)


@given(
    st.sampled_from(list(Mode)),
    st.sampled_from(list(Polarity)),
    st.sampled_from(TICKS),
    st.integers(0, 60),
    st.sampled_from([(346, 260), (1, 1), (8, 4), (4096, 4096), (300, 1)]),
    st.binary(max_size=80),
    st.booleans(),
)
def test_any_payload_under_a_good_header_is_refused_or_sound(mode, polarity, tick_us, count, size, payload, tame):
    """Tamed payloads begin with allowed Rice parameters, or few would get any further."""
    if tame:
        payload = bytes([byte % 28 for byte in payload[:2]]) + payload[2:]
    decoded(Header(mode, tick_us, polarity, count, 77, 0, size).pack() + payload)


@pytest.mark.parametrize("count", [1000, 65_535])
@pytest.mark.parametrize("mode", [Mode.FLAT, Mode.ROWS, Mode.BITMAP, Mode.EDGE])
def test_counts_that_do_not_fit_are_refused(mode, count):
    for payload in (b"", bytes(4), bytes(100)):
        data = Header(mode, 1, Polarity.EACH, count, 0, 0, (346, 260)).pack() + payload
        with pytest.raises(BlockError):
            decode_block(data)


def test_a_few_bytes_never_become_more_events_than_the_header_says():
    data = Header(Mode.BITMAP, 1, Polarity.ALL_ON, 65_535, 0, 0, (4096, 4096)).pack()
    for kl in (0, 1, 12, 15, 20, 24, 27):
        for ones in (0, 1, 7, 15, 16):
            decoded(data + slow_bits(f"{0:08b}{kl:08b}{0:024b}" + "1" * ones + "0" + "1" * (kl + 1)))


def slow_bits(text):
    text += "0" * (-len(text) % 8)
    return bytes(int(text[i : i + 8], 2) for i in range(0, len(text), 8))


@pytest.mark.parametrize("good", GOOD[:25], ids=range(len(GOOD[:25])))
def test_every_truncation_is_refused(good):
    for length in range(len(good)):
        assert decoded(good[:length]) is None


@given(st.sampled_from(GOOD), st.lists(st.tuples(st.integers(14, 400), st.integers(0, 255)), min_size=1, max_size=3))
def test_damaged_payloads_are_refused_or_sound(good, damage):
    data = bytearray(good)
    for at, value in damage:
        data[min(at, len(data) - 1)] = value
    decoded(bytes(data))


def test_up_to_three_wrong_bits_in_a_header_are_found():
    """The CRC is linear: what matters is that no one, two or three bits have a syndrome of zero together."""
    zero = crc8(bytes(13))
    syndromes = {crc8((1 << bit).to_bytes(13, "big")) ^ zero for bit in range(104)} | {1 << bit for bit in range(8)}
    assert len(syndromes) == 112
    assert 0 not in syndromes
    assert not any(a ^ b in syndromes for a, b in itertools.combinations(syndromes, 2))


def accepted(data):
    """What a receiver with a CRC-16 around blocks takes: events, or None."""
    if len(data) < 2 or binascii.crc_hqx(data, 0xFFFF):
        return None
    try:
        return decode_block(data[:-2])
    except BlockError:
        return None


def test_a_count_that_the_payload_does_not_have_is_refused():
    block, taken = BlockEncoder((346, 260)).encode(stream((346, 260), 300, 1000, 9))
    for count in (taken - 1, taken + 1):
        with pytest.raises(BlockError):
            decode_block(changed(block, b2=count >> 8, b3=count & 255))
