"""Hypothesis strategies for payloads, telecommands and messages, and ways to cut a stream of bytes."""

from itertools import pairwise

from hypothesis import strategies as st

from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.telecommands import (
    TICKS_US,
    Failure,
    FailureCode,
    Ping,
    RequestHousekeeping,
    RequestId,
    SetBias,
    SetRateLimit,
    SetRegion,
    SetTick,
    SetTime,
    Stage,
    Start,
    Stop,
    Verification,
)

# Bytes that mean something to a framing: delimiters, escapes, start words.
AWKWARD = st.lists(st.sampled_from([0x00, 0x01, 0xC0, 0xDB, 0xDC, 0xDD, 0xDE, 0xAD, 0xBE, 0xEF, 0xFF])).map(bytes)
LONG_RUNS = st.builds(lambda byte, n: bytes([byte]) * n, st.sampled_from([0, 1, 0xC0]), st.integers(250, 515))
PAYLOADS = st.one_of(
    st.binary(max_size=600),
    AWKWARD,
    LONG_RUNS,
    st.lists(st.sampled_from([b"\xde\xad\xbe\xef", b"\0\0\0\x04", b"x"]), max_size=20).map(b"".join),
)

U16 = st.integers(0, 0xFFFF)
TELECOMMANDS = st.one_of(
    st.sampled_from([Ping(), RequestHousekeeping(), Start(), Stop()]),
    st.builds(SetTime, st.integers(0, 2**32 * 1_000_000 - 1)),
    st.builds(SetTick, st.sampled_from(TICKS_US)),
    st.builds(SetRegion, U16, U16, st.integers(1, 0xFFFF), st.integers(1, 0xFFFF)),
    st.builds(SetRateLimit, st.integers(0, 2**32 - 1)),
    st.builds(SetBias, st.integers(0, 255), U16),
)

FAILURES = st.builds(
    Failure, st.sampled_from(FailureCode), st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=80)
)
VERIFICATIONS = st.builds(Verification, st.sampled_from(Stage), st.builds(RequestId, U16, U16), st.none() | FAILURES)
TIMES_US = st.integers(0, 2**32 * 1_000_000 - 1)
FREE_KINDS = [kind for kind in MessageKind if kind is not MessageKind.VERIFICATION]
MESSAGES = st.one_of(
    st.builds(Message, st.sampled_from(FREE_KINDS), PAYLOADS, TIMES_US),
    st.builds(Message, st.just(MessageKind.VERIFICATION), VERIFICATIONS.map(Verification.encode), TIMES_US),
)


def pieces(data, cuts):
    """Return `data` cut at the places named by `cuts` (any integers)."""
    places = sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    return [data[a:b] for a, b in pairwise(places)]
