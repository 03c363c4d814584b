"""Edges on their way to a camera: times from the bus, rings in shared memory, and a script's period."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EdgeKind
from transports.link.edges import EdgeRing, EdgeSink, EdgeTiming, PeriodicEdges
from transports.link.rings import FREE_RUNNING, EventRing

ORIGIN_NS = 5_000_000_123
FOREVER_US = 1 << 60


def started(origin_ns=ORIGIN_NS):
    run = EventRing(16)
    run.start(origin_ns)
    return run


def times(edges):
    return edges["t"].tolist()


def test_a_bus_stamp_becomes_stream_time_exactly():
    ring = EdgeRing()
    sink = EdgeSink([ring], started(), EdgeTiming(EdgeKind.RISING, channel=2, latency_us=3.5))
    sink(ORIGIN_NS, 7)
    sink(ORIGIN_NS + 10_499, 8)
    sink(ORIGIN_NS + 10_500, 65536 + 9)
    edges = ring.take(FOREVER_US)
    assert times(edges) == [3, 13, 14]
    assert edges["kind"].tolist() == [EdgeKind.RISING] * 3
    assert edges["channel"].tolist() == [2] * 3
    assert edges["seq"].tolist() == [7, 8, 9]


def test_jitter_is_keyed_by_the_edge_and_never_early_nor_out_of_order():
    def heard(seed, step_ns):
        ring = EdgeRing()
        sink = EdgeSink([ring], started(), EdgeTiming(latency_us=20, jitter_us=10, seed=seed))
        for k in range(500):
            sink(ORIGIN_NS + k * step_ns, k)
        return np.array(times(ring.take(FOREVER_US)))

    late_us = heard(1, 1_000_000) - np.arange(500) * 1000
    assert late_us.min() >= 0
    assert late_us.mean() == pytest.approx(20, abs=4 * 10 / np.sqrt(500))
    assert late_us.std() == pytest.approx(10, rel=0.13)
    assert np.array_equal(heard(1, 2_000_000) - np.arange(500) * 2000, late_us)
    assert not np.array_equal(heard(2, 1_000_000), heard(1, 1_000_000))
    assert (np.diff(heard(1, 1000)) >= 0).all()


def test_every_ring_gets_every_edge_and_each_is_taken_once():
    rings = [EdgeRing(), EdgeRing()]
    sink = EdgeSink(rings, started(), EdgeTiming())
    for k in range(10):
        sink(ORIGIN_NS + k * 1000, k)
    assert times(rings[0].take(4)) == [0, 1, 2, 3, 4]
    assert times(rings[0].take(4)) == []
    assert times(rings[0].take(FOREVER_US)) == [5, 6, 7, 8, 9]
    assert times(rings[1].take(FOREVER_US)) == list(range(10))


def test_edges_before_the_run_are_counted_and_make_nothing():
    run, ring = EventRing(16), EdgeRing()
    sink = EdgeSink([ring], run, EdgeTiming())
    sink(1, 0)
    run.start(ORIGIN_NS)
    sink(ORIGIN_NS - 1, 1)
    assert sink.early_triggers == 2
    assert ring.written == 0


def test_a_free_run_puts_an_edge_where_it_has_got_to():
    run, ring = started(FREE_RUNNING), EdgeRing()
    sink = EdgeSink([ring], run, EdgeTiming(latency_us=5))
    run.publish(1000)
    sink(123, 0)
    run.publish(2000)
    sink(124, 1)
    assert times(ring.take(FOREVER_US)) == [1005, 2005]


def test_in_lockstep_an_edge_is_at_its_number():
    ring = EdgeRing()
    sink = EdgeSink([ring], started(FREE_RUNNING), EdgeTiming(latency_us=2), lockstep_us=10_000)
    for _ in range(3):
        sink(99, 0)
    assert times(ring.take(FOREVER_US)) == [2, 10_002, 20_002]


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 30)), max_size=60))
def test_a_ring_gives_what_was_put_in_in_order_and_counts_what_found_no_room(steps):
    ring = EdgeRing(capacity=8)
    sink = EdgeSink([ring], started(), EdgeTiming())
    put, got, t = 0, [], 0
    for is_put, n in steps:
        for _ in range(n if is_put else 0):
            sink(ORIGIN_NS + t * 1000, t)
            t, put = t + 1, put + 1
        if not is_put:
            got += ring.take(t - n)["seq"].tolist()
    got += ring.take(FOREVER_US)["seq"].tolist()
    assert got == sorted(set(got))
    assert len(got) + ring.refused == put


def test_a_period_is_kept_however_it_is_asked():
    whole = PeriodicEdges(1000, EdgeTiming(jitter_us=3, latency_us=10, seed=4))
    pieces = pickle.loads(pickle.dumps(whole))
    expected = whole.take(50_000)
    got = np.concatenate([pieces.take(t) for t in range(0, 50_001, 77)] + [pieces.take(50_000)])
    assert np.array_equal(got, expected)
    assert expected["seq"].tolist() == list(range(len(expected)))
    assert abs(len(expected) - 50) <= 1


def test_a_period_without_jitter_is_exact():
    assert times(PeriodicEdges(2500, EdgeTiming()).take(10_000)) == [2500, 5000, 7500, 10_000]
