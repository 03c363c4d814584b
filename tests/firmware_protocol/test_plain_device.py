"""The device without electronics: order, room, and one fate for everything."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.device.fates import Counts
from firmware_protocol.device.items import Numbers, ReadingKind
from firmware_protocol.device.plain_device import PlainDevice
from firmware_protocol.events import EDGE
from firmware_protocol.evt.evt3 import Evt3Decoder, Evt3Encoder
from firmware_protocol.frames import line_record
from firmware_protocol.imu_samples import no_samples
from tests.made_events import events_at


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 20)), max_size=20), st.integers(1, 60))
def test_every_event_has_one_fate_and_leaves_in_order(turns, capacity):
    device, taken, t = PlainDevice(capacity), [], 0
    for offered, limit in turns:
        device.offer(events_at(range(t, t + offered)))
        t += offered
        if limit and (got := device.take(limit)) is not None:
            taken += got.events["t"].tolist()
            device.sent(got)
        assert device.counters.accounted == device.counters.offered == t
        assert device.room_events >= 0
    assert taken == sorted(taken)
    assert device.counters.delivered == len(taken)
    device.retract(Numbers(len(taken)))
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
    assert (edges.offered, edges.queued, edges.dropped_fifo) == (3, 2, 1)
    device.sent(taken := device.take(1))
    assert len(taken.edges) == 2
    assert device.counters.edges.accounted == 3


def test_time_that_goes_back_is_refused():
    device = PlainDevice()
    device.offer(events_at([5]))
    with pytest.raises(ValueError, match="back in time"):
        device.offer(events_at([4]))


def edges_at(times):
    edges = np.zeros(len(times), EDGE)
    edges["t"] = times
    return edges


def imu_at(times):
    samples = no_samples(len(times))
    samples["t"] = times
    return samples


@given(
    st.lists(st.tuples(st.integers(1, 250), st.integers(0, 40), st.integers(0, 5), st.integers(0, 5)), max_size=12),
    st.lists(st.integers(1, 60), min_size=1, max_size=5),
    st.integers(0, 12),
)
def test_edges_and_readings_leave_between_the_events_of_their_time(steps, limits, restart_at):
    """The edges and readings of a stretch are offered before its events, however long it is."""
    device, rng, t, taken = PlainDevice(readings={ReadingKind.IMU: (1,)}), np.random.default_rng(7), 0, []
    for step, (length, n_events, n_edges, n_samples) in enumerate(steps):
        times = [np.sort(rng.integers(t, t + length + 1, n)) for n in (n_events, n_edges, n_samples)]
        device.offer_edges(edges_at(times[1]))
        device.offer_readings(ReadingKind.IMU, imu_at(times[2]))
        device.offer(events_at(times[0]))
        device.advance(t := t + length)
        for limit in limits:
            if (got := device.take(limit)) is not None:
                taken.append(got)
                device.sent(got)
        if step == restart_at:
            device.restart_clock()
    while (got := device.take(1000)) is not None:
        taken.append(got)
        device.sent(got)
    last_us = 0
    for one in taken:
        times = np.concatenate([one.events["t"], one.edges["t"], *(r.record["t"] for r in one.readings)])
        assert int(times.min()) >= last_us
        last_us = int(times.max())
    counters = device.counters
    assert counters.queued == counters.edges.queued == counters.readings["imu"].queued == 0
    assert counters.edges.delivered == counters.edges.offered == sum(len(one.edges) for one in taken)
    assert counters.readings["imu"].delivered == counters.readings["imu"].offered == sum(len(o.readings) for o in taken)


def test_what_leaves_can_be_coded_as_it_leaves():
    """EVT3 holds events and triggers in one order of time, in files and in messages of ROS 2."""
    device, encoder = PlainDevice(), Evt3Encoder(standalone=True)
    for start in range(0, 1_000_000, 250_000):
        device.offer_edges(edges_at(range(start + 50_000, start + 250_001, 50_000)))
        device.offer(events_at(range(start, start + 250_000, 100)))
        device.advance(start + 250_000)
    decoder, times = Evt3Decoder(), []
    while (taken := device.take(1000)) is not None:
        events, edges = decoder.decode(encoder.encode(taken.events, taken.edges))
        times += [*events["t"].tolist(), *edges["t"].tolist()]
    assert len(times) == 10_000 + 20
    assert encoder.encode(events_at([1_000_000]))


def test_an_edge_ahead_of_the_time_reached_waits_and_a_late_one_is_dated_as_early_as_possible():
    device = PlainDevice()
    device.offer(events_at([10, 20]))
    device.offer_edges(edges_at([15, 40]))
    assert device.take(9).edges["t"].tolist() == [15]
    device.offer_edges(edges_at([12]))
    assert device.take(9).edges["t"].tolist() == [20]
    assert device.take(9) is None
    device.advance(40)
    assert device.take(9).edges["t"].tolist() == [40]


def test_readings_that_nobody_asks_for_are_refused_and_others_have_one_fate():
    device = PlainDevice(readings={ReadingKind.IMU: (1, 2)})
    assert device.reading_settings(ReadingKind.IMU) == (1, 2)
    assert device.reading_settings(ReadingKind.FRAMES) == ()
    assert not device.offer_readings(ReadingKind.FRAMES, np.zeros(1, line_record(4)))
    assert device.offer_readings(ReadingKind.IMU, imu_at(range(20_000)))
    room = device.room_readings(ReadingKind.IMU)
    device.drop_waiting()
    device.offer_readings(ReadingKind.IMU, imu_at(range(100)))
    device.advance(100)
    device.sent(device.take(1))
    device.retract(Numbers(readings=Counter({ReadingKind.IMU: 40})))
    device.run(False)
    device.offer_readings(ReadingKind.IMU, imu_at(range(200, 205)))
    counters = device.counters.readings["imu"]
    assert room == 0
    assert counters == Counts(offered=20_105, not_running=5, dropped_fifo=20_000, delivered=60, lost_on_link=40)
    assert counters.accounted == counters.offered
