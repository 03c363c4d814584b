"""The queue before a narrow line: bounds, policies, and gaps told exactly where they are."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import example, given

from firmware_protocol.instrument.queue import EventQueue, Policy, QueueBounds
from tests.made_events import events_at


def queue(policy=Policy.OLDEST, most=10, age_us=1000, block=4):
    return EventQueue(QueueBounds(most, age_us, block, policy))


def test_the_oldest_give_way_at_the_head():
    q = queue(most=4)
    assert q.put(events_at(range(6)), 5).full == 2
    assert q.head(8)["t"].tolist() == [2, 3, 4, 5]
    assert q.dropped_before == 2


def test_the_newest_are_refused_until_a_block_has_room():
    q = queue(Policy.NEWEST, most=6, block=4)
    assert q.put(events_at(range(8)), 7).full == 2
    q.remove(len(q.head(3)), 0)
    assert q.put(events_at([10]), 10).full == 1, "there is room for 3 only"
    q.remove(len(q.head(1)), 0)
    assert q.put(events_at([11]), 11).full == 0
    assert q.head(8)["t"].tolist() == [4, 5], "a block does not span the gap"
    q.remove(2, q.dropped_before)
    assert q.dropped_before == 3
    assert q.head(8)["t"].tolist() == [11]


@pytest.mark.parametrize("policy", list(Policy))
def test_what_waits_too_long_gives_way(policy):
    q = queue(policy, age_us=100)
    q.put(events_at([0, 90]), 90)
    assert q.put(events_at([150]), 150).late == 1
    assert q.head(8)["t"].tolist() == ([90, 150] if policy is Policy.OLDEST else [0, 90])


def test_time_alone_makes_the_oldest_too_old():
    q = queue(age_us=100)
    q.put(events_at([0, 50]), 50)
    assert q.trim(100).late == 0
    assert q.trim(101).late == 1
    assert q.trim(500).late == 1
    assert q.dropped_before == 2


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("put"), st.lists(st.integers(0, 40), max_size=9)),
        st.tuples(st.just("take"), st.integers(1, 6)),
        st.tuples(st.just("trim"), st.integers(0, 200)),
        st.tuples(st.just("clear"), st.just(0)),
    ),
    max_size=40,
)


@example([("put", [0, 0, 0]), ("clear", 0), ("put", [0]), ("take", 1)], Policy.OLDEST, 12, 5, 10**9)
@given(STEPS, st.sampled_from(Policy), st.integers(1, 12), st.integers(1, 5), st.sampled_from([1, 3, 10**9]))
def test_any_life_loses_nothing_untold(steps, policy, most, block, told_at_most):
    """What went in came out, waits or was dropped; and each gap is told exactly before the event behind it."""
    q = queue(policy, most=most, age_us=150, block=block)
    now, serial, dropped, out, told = 0, 0, 0, [], 0
    gap_told = {}
    for what, argument in steps:
        if what == "put":
            times = now + np.cumsum(argument)
            batch = events_at(times)
            batch["x"] = (serial + np.arange(len(batch))) % 65536
            serial += len(batch)
            now = int(times[-1]) if len(times) else now
            dropped += q.put(batch, now).total
        elif what == "trim":
            now += argument
            dropped += q.trim(now).total
        elif what == "clear":
            dropped += q.clear()
        else:
            head = q.head(argument).copy()
            tell = min(q.dropped_before, told_at_most)
            q.remove(len(head), tell)
            told += tell
            if len(head):
                gap_told[int(head["x"][0])] = told
            out += head["x"].tolist()
            assert (np.diff(head["x"].astype(int)) == 1).all(), "a gap inside a block"
    assert serial == len(out) + dropped + q.waiting
    assert q.waiting <= most
    for first, told_then in gap_told.items():
        gone_before = first - out.index(first)
        assert told_then <= gone_before
        if told_at_most >= serial:
            assert told_then == gone_before
