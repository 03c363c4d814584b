"""The ring between the sensor and a link."""

import errno
import multiprocessing
import select
import tempfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.made_events import events_at
from transports.link.deliveries import DeliveryTally
from transports.link.rings import FOREVER_US, FREE_RUNNING, EventRing


def ramp(times):
    return events_at(times, x=np.arange(len(times)) % 346)


@given(st.integers(1, 50), st.lists(st.tuples(st.integers(0, 60), st.integers(0, 60)), max_size=20))
def test_a_ring_gives_back_what_it_took_in_order(capacity, pushes_and_takes):
    ring = EventRing(capacity)
    t, pushed, taken = 0, [], []
    for push, take in pushes_and_takes:
        batch = ramp(range(t, t + push))
        n = ring.push(batch)
        t += push
        pushed.extend(batch["t"][:n])
        taken.extend(ring.take(10**9, take)["t"])
        assert ring.waiting + ring.room == capacity
    taken.extend(ring.take(10**9)["t"])
    assert taken == pushed
    assert ring.refused == t - len(pushed)


def test_neither_a_ring_nor_a_tally_needs_a_folder(monkeypatch):
    """/dev/shm and /tmp may be read-only, or small."""

    def refuse(*_, **__):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(tempfile, "mkstemp", refuse)
    ring, tally = EventRing(1 << 20), DeliveryTally()
    tally.delivered = ring.push(ramp([5]))
    assert (tally.delivered, ring.waiting) == (1, 1)


def test_a_ring_needs_room_for_an_event():
    with pytest.raises(ValueError, match="at least one"):
        EventRing(0)


def woken(ring):
    return bool(select.select([ring.wakes], [], [], 0)[0])


def test_a_writer_wakes_a_reader_that_sleeps_beyond_its_events_once_for_each_sleep():
    ring = EventRing(100)
    ring.sleep(1000)
    ring.push(ramp([1000, 1001]))
    ring.publish(2000)
    assert not woken(ring)  # both are due when it wakes anyway
    ring.sleep(1500)
    ring.push(ramp([1499, 1600]))
    assert not woken(ring)  # not published
    ring.publish(2500)
    assert woken(ring)
    ring.woken()
    ring.push(ramp([1499]))
    ring.publish(2600)
    assert not woken(ring)  # it is awake


def test_a_reader_that_is_up_to_date_is_woken_by_any_publication_and_by_the_start():
    ring = EventRing(100)
    for publish in (lambda: ring.start(FREE_RUNNING), lambda: ring.publish(10), lambda: ring.publish(20)):
        ring.sleep(FOREVER_US)
        publish()
        assert woken(ring)
        ring.woken()
        assert not woken(ring)


def test_wake_ups_that_nobody_reads_do_not_stop_the_writer():
    ring = EventRing(10)
    for k in range(100_000):  # more than the pipe holds
        ring.sleep(FOREVER_US)
        ring.publish(k)
    assert ring.now_us == 99_999


def _write(ring, count):
    for start in range(0, count, 1000):
        batch = ramp(range(start, start + 1000))
        while len(batch):
            batch = batch[ring.push(batch) :]
        ring.publish(start + 999)
    ring.close()


def test_another_process_writes_while_this_one_reads():
    ring = EventRing(3000)
    count = 200_000
    writer = multiprocessing.get_context("spawn").Process(target=_write, args=(ring, count))
    writer.start()
    times = []
    while not (ring.closed and ring.waiting == 0):
        now_us = ring.now_us
        times.append(ring.take(now_us)["t"])
    writer.join()
    assert np.array_equal(np.concatenate(times), np.arange(count))
