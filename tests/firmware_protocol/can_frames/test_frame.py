"""CAN frames: text as can-utils writes it, and the bits that a frame takes."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.can_frames.frame import (
    FD_LENGTHS,
    BitRates,
    BusShare,
    Frame,
    FrameError,
    crc15,
    fd_length,
    frame_bits,
)


@st.composite
def frames(draw):
    extended, fd = draw(st.booleans()), draw(st.booleans())
    length = draw(st.sampled_from(FD_LENGTHS if fd else range(9)))
    identifier = draw(st.integers(0, (1 << (29 if extended else 11)) - 1))
    # Long runs of equal bits are what stuffing is about.
    data = b"".join(
        draw(st.lists(st.sampled_from([b"\0", b"\xff", b"\x0f", b"\x5a"]), min_size=length, max_size=length))
    )
    return Frame(identifier, data, extended, fd, fd and draw(st.booleans()))


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (Frame(0x123, b"\x11\x22"), "123#1122"),
        (Frame(0x123, extended=True), "00000123#"),
        (Frame(0x1AB, b"\xaa\xbb", fd=True, brs=True), "1AB##1AABB"),
        (Frame(0x40, bytes(8), error=True), "20000040#0000000000000000"),
    ],
)
def test_a_frame_is_written_as_candump_writes_it(frame, text):
    assert str(frame) == text
    assert Frame.parse(text) == frame


@given(frames())
def test_text_comes_back(frame):
    assert Frame.parse(str(frame)) == frame


@given(st.text(st.sampled_from("0123456789ABCDEF#.R "), max_size=40))
def test_foreign_text_is_a_frame_or_refused(text):
    with suppress(FrameError):
        assert Frame.parse(text) == Frame.parse(str(Frame.parse(text)))


@pytest.mark.parametrize(
    "wrong",
    [
        {"identifier": 0x800},
        {"identifier": 1 << 29, "extended": True},
        {"identifier": -1},
        {"identifier": 1, "data": bytes(9)},
        {"identifier": 1, "data": bytes(9), "fd": True},
        {"identifier": 1, "brs": True},
        {"identifier": 1, "fd": True, "error": True},
    ],
)
def test_what_no_bus_carries_is_refused(wrong):
    with pytest.raises(FrameError):
        Frame(**wrong)


def test_fd_lengths():
    assert [fd_length(n) for n in (0, 8, 9, 33, 64)] == [0, 8, 12, 48, 64]
    with pytest.raises(FrameError):
        fd_length(65)


def bits_by_hand(frame):
    """All bits of a classic frame, stuffed one by one: slow, and written from the standard alone."""

    def number(value, n):
        return [value >> i & 1 for i in range(n - 1, -1, -1)]

    head = [0]
    if frame.extended:
        head += number(frame.identifier >> 18, 11) + [1, 1] + number(frame.identifier & 0x3FFFF, 18) + [0, 0, 0]
    else:
        head += number(frame.identifier, 11) + [0, 0, 0]
    bits = head + number(len(frame.data), 4) + [b for byte in frame.data for b in number(byte, 8)]
    crc = 0
    for bit in bits:
        turn = bit ^ crc >> 14
        crc = crc << 1 & 0x7FFF
        if turn:
            crc ^= 0x4599
    bits += number(crc, 15)
    sent = []
    for bit in bits:
        sent.append(bit)
        if sent[-5:] == [bit] * 5:
            sent.append(1 - bit)
    return len(sent) + 13


@given(frames().filter(lambda f: not f.fd))
def test_bits_of_a_classic_frame_are_those_counted_by_hand(frame):
    assert frame_bits(frame).nominal == bits_by_hand(frame)


def test_bits_of_the_longest_frames():
    fd = frame_bits(Frame(0x555, b"\x55" * 64, fd=True, brs=True))
    assert (fd.nominal, fd.fast) == (30, 1 + 4 + 512 + 4 + 21 + 7)


def test_the_crc_of_can():
    # CRC-15/CAN of the catalogue of parametrised CRC algorithms: check value of "123456789".
    assert crc15(int.from_bytes(b"123456789", "big"), 72) == 0x059E


def test_what_urgent_frames_take_is_missing_for_the_others():
    bucket = BusShare(BitRates(1_000_000), 0.5)
    ordinary, urgent = Frame(0x1A2, bytes(8)), Frame(0x080)
    busy_ns = 0
    for now_ns in range(0, 1_000_000_000, 100_000):
        if now_ns % 1_000_000 == 0:
            busy_ns += bucket.spend(urgent, now_ns)
        while bucket.has_room(now_ns):
            busy_ns += bucket.spend(ordinary, now_ns)
    assert busy_ns / 1e9 == pytest.approx(0.5, rel=0.02)


def test_a_bucket_says_what_is_wrong():
    with pytest.raises(ValueError, match="share"):
        BusShare(BitRates(), 0.0)
    with pytest.raises(ValueError, match="fast bit rate"):
        BitRates(1_000_000, 500_000)
