"""The device without electronics: order, room, and one fate for everything."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.edges import EDGE
from firmware_protocol.events import EVENT
from firmware_protocol.plain_device import PlainDevice


def events_at(times):
    events = np.zeros(len(times), EVENT)
    events["t"] = times
    return events


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 20)), max_size=20), st.integers(1, 60))
def test_every_event_has_one_fate_and_leaves_in_order(turns, capacity):
    device, taken, t = PlainDevice(capacity), [], 0
    for offered, limit in turns:
        device.offer(events_at(range(t, t + offered)))
        t += offered
        if limit and (got := device.take(limit)) is not None:
            taken += got.events["t"].tolist()
        assert device.counters.accounted == device.counters.offered == t
        assert device.room_events >= 0
    assert taken == sorted(taken)
    assert device.counters.delivered == len(taken)
    device.lost(len(taken))
    device.drop_waiting()
    counters = device.counters
    assert (counters.queued, counters.delivered, counters.lost_on_link) == (0, 0, len(taken))
    assert counters.accounted == t


def test_a_restarted_clock_comes_with_what_is_offered_from_then_on():
    device = PlainDevice()
    device.offer(events_at([5]))
    device.advance(10)
    assert device.restart_clock()
    device.offer(events_at([12]))
    assert [device.take(9).epoch_us for _ in range(2)] == [0, 10]
    assert device.take(9) is None


def test_edges_have_fates_too():
    device = PlainDevice(2)
    device.offer_edges(np.zeros(3, EDGE))
    edges = device.counters.edges
    assert (edges.offered, edges.queued, edges.dropped) == (3, 2, 1)
    assert len(device.take(1).edges) == 2
    assert device.counters.edges.accounted == 3


def test_time_that_goes_back_is_refused():
    device = PlainDevice()
    device.offer(events_at([5]))
    with pytest.raises(ValueError, match="back in time"):
        device.offer(events_at([4]))
