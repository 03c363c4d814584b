"""One damaged bit or byte costs at most two messages, is always counted, and never makes a message up. At length:

EVSTIM_LINK_DAMAGE=1000000 python -m pytest tests/firmware_protocol/test_link_damage.py --timeout 0
"""

import os
import random
from collections import Counter
from itertools import islice

import pytest
from hypothesis import given
from hypothesis import strategies as st
from packet_strategies import MESSAGES, pieces

from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.profile import PROFILES, Profile

STREAMS = [name for name in PROFILES if name not in ("ccsds", "csp")]
TRIES = int(os.environ.get("EVSTIM_LINK_DAMAGE", "1000"))
MAX_PAYLOAD = 256
STREAM = 3
TRIES_PER_STREAM = 200


def payload(source):
    """A payload of one of the kinds that framings find hard, at most MAX_PAYLOAD long."""
    length = source.randrange(1, MAX_PAYLOAD + 1)
    kind = source.randrange(4)
    if kind == 0:
        return source.randbytes(length)
    if kind == 1:
        return bytes(source.choices((0, 0, 1, 2, 255), k=length))
    if kind == 2:
        return bytes(source.choices((0xC0, 0xDB, 0xDC, 0xDD, 0), k=length))
    return (b"\xde\xad\xbe\xef\0\0\0\x10" * (length // 8 + 1))[:length]


def damaged(source, stream):
    """The stream with one bit flipped, one byte lost, or one added."""
    at = source.randrange(len(stream))
    kind = source.randrange(3)
    if kind == 0:
        return stream[:at] + bytes([stream[at] ^ 1 << source.randrange(8)]) + stream[at + 1 :]
    if kind == 1:
        return stream[:at] + stream[at + 1 :]
    return stream[:at] + bytes([source.randrange(256)]) + stream[at:]


def tries(name, seed):
    """Yield the results of one try after another, without end."""
    source = random.Random(f"{name} {seed}")
    profile = Profile(name, max_payload=MAX_PAYLOAD)
    while True:
        events = [Message(MessageKind.EVENTS, payload(source), source.randrange(2**40)) for _ in range(STREAM)]
        before = Message(MessageKind.EVENTS, b"before", 0)
        # Two frames in front and behind take no damage: they make the counts tell of every loss between them.
        front = profile.wrap(before)
        stream = b"".join(map(profile.wrap, events))
        behind = [Message(MessageKind.EVENTS, b"behind", 1), Message(MessageKind.EVENTS, bytes(MAX_PAYLOAD), 2)]
        tail = b"".join(map(profile.wrap, behind))
        for _ in range(TRIES_PER_STREAM):
            yield result(source, profile, [before, *events, *behind], (front, stream, tail))


def result(source, profile, messages, parts):
    """Damage the middle part; return (messages lost, wrong messages, losses that the counts do not tell)."""
    front, stream, tail = parts
    unwrapper = profile.unwrapper()
    got = [r.message for r in unwrapper.push(front + damaged(source, stream) + tail)]
    sent = iter(messages)
    wrong = sum(1 for message in got if not any(message == other for other in sent))
    lost = len(messages) - len(got) + wrong
    untold = lost - unwrapper.counters.missing if got and got[-1] == messages[-1] else 0
    return lost, wrong, untold


def survey(name, count, seed=0):
    """Return the number of tries by messages lost, wrong messages, and losses untold, over `count` tries."""
    lost, wrong, untold = Counter(), 0, 0
    for n, bad, hidden in islice(tries(name, seed), count):
        lost[n] += 1
        wrong += bad
        untold += hidden != 0
    return lost, wrong, untold


@pytest.mark.parametrize("name", STREAMS)
def test_one_damaged_byte_costs_at_most_two_messages_and_makes_none_up(name):
    lost, wrong, untold = survey(name, TRIES, seed=1)
    assert sum(lost.values()) == TRIES
    assert max(lost) <= 2
    assert wrong == 0
    assert untold == 0


EDITS = st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 300), st.binary(max_size=40)), min_size=1, max_size=6)


@pytest.mark.parametrize("name", STREAMS)
@given(
    messages=st.lists(MESSAGES, min_size=1, max_size=5), edits=EDITS, cuts=st.lists(st.integers(0, 10_000), max_size=6)
)
def test_whatever_is_cut_out_and_put_in_only_messages_that_were_sent_come_out(name, messages, edits, cuts):
    profile = Profile(name, max_payload=700)
    stream = b"".join(map(profile.wrap, messages))
    for at, length, junk in edits:
        at %= len(stream) + 1
        stream = stream[:at] + junk + stream[at + length :]
    unwrapper = profile.unwrapper()
    got = [received.message for piece in pieces(stream, cuts) for received in unwrapper.push(piece)]
    sent = iter(messages)
    assert all(any(message == other for other in sent) for message in got)
    counters = unwrapper.counters
    assert counters.packets == len(got)
    assert 0 <= counters.frames.pending <= 2 * 800
    assert counters.frames.frames == counters.packets + counters.idle + sum(counters.refused.values())
