"""One damaged bit or byte costs at most two messages, is always counted, and never makes a message up."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from link_damage import survey
from packet_strategies import MESSAGES, pieces

from firmware_protocol.packets.profile import PROFILES, Profile

STREAMS = [name for name in PROFILES if name not in ("ccsds", "csp")]
TRIES = 1000


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
