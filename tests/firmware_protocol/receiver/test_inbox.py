"""The inbox of a receiver: bounded, oldest out first, and every record either taken or counted."""

import hypothesis.strategies as st
import numpy as np
from hypothesis import given

from firmware_protocol.events import EDGE, EVENT
from firmware_protocol.receiver.instrument import Inbox


def numbered(dtype, first, count):
    records = np.zeros(count, dtype)
    records["t"] = np.arange(first, first + count)
    return records


@given(st.lists(st.one_of(st.integers(0, 30), st.just("take"))))
def test_the_newest_are_kept_in_order(steps):
    inbox, put, waiting, dropped = Inbox(most_events=20, most_edges=20), 0, [], 0
    for step in [*steps, "take"]:
        if step == "take":
            assert inbox.take_events()["t"].tolist() == inbox.take_edges()["t"].tolist() == waiting
            waiting = []
            continue
        inbox.put_events(numbered(EVENT, put, step))
        inbox.put_edges(numbered(EDGE, put, step))
        waiting += range(put, put + step)
        put, dropped, waiting = put + step, dropped + max(0, len(waiting) - 20), waiting[-20:]
    assert inbox.counts.get("events not taken", 0) == inbox.counts.get("edges not taken", 0) == dropped
