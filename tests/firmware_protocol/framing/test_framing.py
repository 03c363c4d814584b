"""The framings: golden bytes, round trips, any cut of the stream, damage, hostile bytes, bounded memory."""

import random
from collections.abc import Callable
from typing import NamedTuple

import pytest
from cobs import cobs as cobs_oracle
from hypothesis import given
from hypothesis import strategies as st
from packet_strategies import PAYLOADS, pieces

from firmware_protocol import framing as ours
from firmware_protocol.framing import FrameError, StreamDeframer


class Framing(NamedTuple):
    name: str
    frame: Callable[[bytes], bytes]
    deframer: Callable[..., StreamDeframer]


cobs = Framing("cobs", ours.cobs_frame, ours.CobsDeframer)
slip = Framing("slip", ours.slip_frame, ours.SlipDeframer)
kiss = Framing("kiss", ours.kiss_frame, ours.KissDeframer)
fprime = Framing("fprime", ours.fprime_frame, ours.FPrimeDeframer)
FRAMINGS = [cobs, slip, kiss, fprime]

framings = pytest.mark.parametrize("framing", FRAMINGS, ids=lambda framing: framing.name)


def counted(counters):
    return (
        counters.bytes_received,
        counters.bytes_framed,
        counters.bytes_skipped,
        counters.frames,
        dict(counters.refused),
    )


@pytest.mark.parametrize(
    ("framing", "payload", "line"),
    [
        # The examples of the paper and of Wikipedia's article on COBS.
        (cobs, "", "01 00"),
        (cobs, "00", "01 01 00"),
        (cobs, "00 00", "01 01 01 00"),
        (cobs, "00 11 00", "01 02 11 01 00"),
        (cobs, "11 22 00 33", "03 11 22 02 33 00"),
        (cobs, "11 22 33 44", "05 11 22 33 44 00"),
        (cobs, "11 00 00 00", "02 11 01 01 01 00"),
        (slip, "01 c0 02 db 03", "c0 01 db dc 02 db dd 03 c0"),
        # Written by libcsp's csp_kiss_tx (CSP_21, version 2): priority 2, node 10 port 8 to node 1 port 9.
        (kiss, "80 01 00 28 92 00 c0 65 76 73 db 00", "c0 00 80 01 00 28 92 00 db dc 65 76 73 db dd 00 9c 78 58 21 c0"),
        # The checksum is what F Prime's own lib_crc.c gives for the twelve bytes before it.
        (fprime, "01 02 03 04", "de ad be ef 00 00 00 04 01 02 03 04 e3 f9 a0 73"),
    ],
)
def test_golden_bytes(framing, payload, line):
    payload, line = bytes.fromhex(payload), bytes.fromhex(line)
    assert framing.frame(payload) == line
    assert framing.deframer().push(line) == [payload]


@pytest.mark.parametrize("length", [1, 253, 254, 255, 508, 509, 1000])
@pytest.mark.parametrize("tail", [b"", b"\0", b"\0\0", b"\1"])
def test_cobs_at_the_limits_of_its_groups(length, tail):
    payload = b"\x11" * length + tail
    assert ours.cobs_encode(payload) == cobs_oracle.encode(payload)
    assert ours.cobs_decode(ours.cobs_encode(payload)) == payload
    assert len(ours.cobs_encode(payload)) <= ours.cobs_longest(len(payload))


@given(PAYLOADS)
def test_cobs_agrees_with_the_cobs_package(payload):
    assert ours.cobs_encode(payload) == cobs_oracle.encode(payload)
    assert ours.cobs_decode(cobs_oracle.encode(payload)) == payload


@given(st.binary(min_size=1, max_size=300))
def test_cobs_takes_what_the_cobs_package_takes(piece):
    try:
        expected = cobs_oracle.decode(piece)
    except cobs_oracle.DecodeError:
        with pytest.raises(FrameError):
            ours.cobs_decode(piece)
    else:
        assert ours.cobs_decode(piece) == expected


@framings
@given(
    junk=st.lists(st.one_of(st.binary(max_size=80), PAYLOADS), max_size=8),
    framed=st.lists(st.booleans(), min_size=8, max_size=8),
    cuts=st.lists(st.integers(0, 10_000), max_size=12),
    max_payload=st.sampled_from([16, 64, 300]),
)
def test_any_cut_of_a_hostile_stream_gives_the_same(framing, junk, framed, cuts, max_payload):
    stream = b"".join(framing.frame(part) if good else part for part, good in zip(junk, framed, strict=False))
    whole, cut = framing.deframer(max_payload), framing.deframer(max_payload)
    expected = whole.push(stream)
    assert [payload for piece in pieces(stream, cuts) for payload in cut.push(piece)] == expected
    assert counted(whole.counters) == counted(cut.counters)
    assert all(len(payload) <= max_payload for payload in expected)


@framings
def test_a_payload_of_the_greatest_length_passes_and_one_more_byte_does_not(framing):
    for worst in (b"\0", b"\xc0", b"x"):
        deframer = framing.deframer(100)
        assert deframer.push(framing.frame(worst * 100)) == [worst * 100]
        assert deframer.push(framing.frame(worst * 101)) == []
        assert deframer.push(framing.frame(b"after")) == [b"after"]
        assert sum(deframer.counters.refused.values()) >= 1


@framings
def test_random_bytes_give_no_frame_with_a_checksum_and_are_all_accounted_for(framing):
    source = random.Random(4)
    deframer = framing.deframer(1000)
    frames = 0
    for _ in range(40):
        data = source.randbytes(25_000)
        at = 0
        while at < len(data):
            step = source.randrange(1, 5000)
            frames += len(deframer.push(data[at : at + step]))
            at += step
            assert deframer.counters.pending <= 2 * 1000 + 16
    counters = deframer.counters
    assert counters.bytes_received == 1_000_000
    assert counters.frames == frames
    if framing in (kiss, fprime):
        assert frames == 0


@framings
def test_after_random_bytes_the_second_frame_at_the_latest_comes_through(framing):
    source = random.Random(5)
    for _ in range(100):
        deframer = framing.deframer(64)
        deframer.push(source.randbytes(200))
        got = [payload for i in range(30) for payload in deframer.push(framing.frame(bytes([65 + i]) * 20))]
        assert got[-29:] == [bytes([65 + i]) * 20 for i in range(30)][1:]


@pytest.mark.parametrize(
    ("framing", "line", "reason"),
    [
        (cobs, b"\x05ab\0", "group too long"),
        (slip, b"\xc0a\xdbb\xc0", "escape"),
        (slip, b"\xc0a\xdb\xc0", "escape"),
        (kiss, b"\xc0\x10abcdef\xc0", "command"),
        (kiss, b"\xc0\x00abc\xc0", "short"),
        (kiss, b"\xc0\x00abcdef\xc0", "crc"),
        (kiss, b"\xc0\x00a\xdbcdef\xc0", "escape"),
        (fprime, b"\xde\xad\xbe\xef\0\0\0\1abcde", "crc"),
        (fprime, b"\xde\xad\xbe\xef\xff\xff\xff\xff", "too long"),
    ],
)
def test_what_is_wrong_is_counted_by_its_reason(framing, line, reason):
    deframer = framing.deframer()
    assert deframer.push(line) == []
    assert dict(deframer.counters.refused) == {reason: 1}


def test_fprime_finds_the_frame_that_a_broken_length_spans():
    broken = bytearray(fprime.frame(b"first"))
    broken[7] += 10
    deframer = fprime.deframer(100)
    assert deframer.push(bytes(broken) + fprime.frame(b"second") + fprime.frame(b"third")) == [b"second", b"third"]
    assert deframer.counters.refused == {"crc": 1}


def test_fprime_takes_a_start_word_in_the_data_for_data():
    payload = b"\xde\xad\xbe\xef" * 3
    assert fprime.deframer().push(fprime.frame(payload)) == [payload]


@pytest.mark.parametrize("framing", [cobs, slip, kiss])
def test_a_line_without_delimiters_stays_bounded_and_counts_as_one_bad_frame(framing):
    deframer = framing.deframer(100)
    for _ in range(1000):
        assert deframer.push(b"\x55" * 77) == []
        assert deframer.counters.pending <= 2 * 100 + 16
    assert deframer.push(framing.frame(b"x")[-1:] + framing.frame(b"after")) == [b"after"]
    assert dict(deframer.counters.refused) == {"too long": 1}
    assert deframer.counters.bytes_skipped == 77_001


def test_a_flood_of_start_words_stays_bounded():
    deframer = fprime.deframer(256)
    for _ in range(200):
        assert deframer.push(b"\xde\xad\xbe\xef\0\0\0\xff" * 20) == []
        assert deframer.counters.pending <= 256 + 12


# What libcsp writes when built without CSP_21: the same packet as above, the checksum over its data alone.
WITHOUT_HEADER = bytes.fromhex("c0 00 80 01 00 28 92 00 db dc 65 76 73 db dd 00 ce 66 16 18 c0")


def test_kiss_takes_a_checksum_without_the_header_only_when_told():
    payload = bytes.fromhex("80 01 00 28 92 00 c0 65 76 73 db 00")
    assert kiss.deframer().push(WITHOUT_HEADER) == []
    assert kiss.deframer(header_bytes=6).push(WITHOUT_HEADER) == [payload]
    assert kiss.deframer(header_bytes=6).push(kiss.frame(payload)) == [payload]


def test_datagrams_are_taken_one_by_one():
    deframer = ours.SealedPacketDeframer(10)
    assert deframer.push(ours.sealed(b"packet")) == [b"packet"]
    assert deframer.push(ours.sealed(b"packet")[:-1]) == []
    assert deframer.push(ours.sealed(b"too long for this")) == []
    assert deframer.push(b"") == []
    assert dict(deframer.counters.refused) == {"crc": 1, "too long": 1, "short": 1}
    assert deframer.counters.pending == 0
