"""CRC, COBS, SLIP and KISS in C, against other people's implementations and plain ones."""

import binascii

import fastcrc
import pytest
from cobs import cobs
from hypothesis import example, given
from hypothesis import strategies as st

# Zeros and the bytes that SLIP escapes, more often than chance.
BYTES = st.one_of(st.integers(0, 255), st.sampled_from([0, 0xC0, 0xDB]))
PAYLOADS = st.lists(BYTES, min_size=1, max_size=600).map(bytes)
ROOMY = (4096, 0)


def slip(payload):
    return payload.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc") + b"\xc0"


def kiss(payload):
    crc = fastcrc.crc32.iscsi(payload).to_bytes(4, "big")
    return b"\xc0" + slip(b"\0" + payload + crc)


FRAMINGS = {"c": lambda payload: cobs.encode(payload) + b"\0", "s": slip, "k": kiss}


@pytest.mark.parametrize(("data", "crc"), [(b"123456789", 0x29B1), (b"", 0xFFFF), (b"\0", 0xE1F0)])
def test_crc_check_values(library, data, crc):
    assert library("r", data).counters == [crc]


@given(st.binary(max_size=300))
def test_crc_is_that_of_the_standard_library(library, data):
    assert library("r", data).counters == [binascii.crc_hqx(data, 0xFFFF)]


@given(st.binary(max_size=300))
@example(b"123456789")
def test_crc32c_is_that_of_another_implementation(library, data):
    assert library("R", data).counters == [fastcrc.crc32.iscsi(data)]


@given(PAYLOADS, st.data())
def test_a_kiss_frame_with_another_command_or_checksum_is_refused(library, payload, data):
    frame = bytearray(kiss(payload))
    wrong = data.draw(st.integers(1, 255))
    frame[1] ^= wrong
    reply = library("k", bytes(frame) + kiss(b"next"), size=ROOMY)
    assert reply.frames == [b"next"]
    assert reply.counters[0] == 1
    sealed = payload + (fastcrc.crc32.iscsi(payload) ^ wrong).to_bytes(4, "big")
    reply = library("k", slip(b"\0" + sealed) + slip(b"\0abc") + slip(b"\0") + kiss(b"next"), size=ROOMY)
    assert (reply.frames, reply.counters) == ([b"next"], [1, 0, 0, 2])


@pytest.mark.parametrize("mode", FRAMINGS)
@given(st.lists(PAYLOADS, max_size=5))
@example([b"\0", b"\0\0", bytes(range(1, 255)), bytes(range(1, 256)), b"\xff" * 254 + b"\0", b"\x01" * 508])
def test_payloads_come_back(library, mode, payloads):
    reply = library(mode, b"".join(map(FRAMINGS[mode], payloads)), size=ROOMY)
    assert reply.frames == payloads
    assert reply.counters == [len(payloads), 0, 0, 0]


@given(st.lists(st.one_of(st.integers(0, 255), st.integers(0, 5), st.just(0xFF)), max_size=600).map(bytes))
def test_any_bytes_are_cobs_frames_exactly_where_another_decoder_says_so(library, data):
    whole, malformed = [], 0
    for piece in data.split(b"\0")[:-1]:
        try:
            payload = cobs.decode(piece)
        except cobs.DecodeError:
            malformed += 1
        else:
            whole += [payload] if payload else []
    reply = library("c", data, size=ROOMY)
    assert reply.frames == whole
    assert reply.counters == [len(whole), malformed, 0, 0]


@given(st.lists(st.one_of(st.integers(0, 255), st.sampled_from([0xC0, 0xDB, 0xDC, 0xDD])), max_size=300).map(bytes))
def test_any_bytes_are_slip_frames_exactly_where_a_plain_decoder_says_so(library, data):
    whole, malformed = [], 0
    data += b"\xc0"
    for piece in data.split(b"\xc0")[:-1]:
        parts = piece.split(b"\xdb")
        if all(part[:1] in (b"\xdc", b"\xdd") for part in parts[1:]):
            tails = ({0xDC: b"\xc0", 0xDD: b"\xdb"}[part[0]] + part[1:] for part in parts[1:])
            payload = b"".join([parts[0], *tails])
            whole += [payload] if payload else []
        else:
            malformed += 1
    reply = library("s", data, size=ROOMY)
    assert reply.frames == whole
    assert reply.counters == [len(whole), malformed, 0, 0]


@pytest.mark.parametrize("mode", FRAMINGS)
def test_a_frame_may_fill_the_buffer_and_not_more(library, mode):
    frame = FRAMINGS[mode]
    data = frame(bytes(range(100))) + frame(bytes(range(101))) + frame(b"next")
    reply = library(mode, data, size=(104 if mode == "k" else 100, 0))
    assert reply.frames == [bytes(range(100)), b"next"]
    assert reply.counters == [2, 0, 1, 0]


@pytest.mark.parametrize("mode", FRAMINGS)
def test_no_buffer_takes_nothing(library, mode):
    reply = library(mode, FRAMINGS[mode](b"abc"), size=(0, 0))
    assert reply.frames == []
    assert reply.counters == [0, 0, 1, 0]
