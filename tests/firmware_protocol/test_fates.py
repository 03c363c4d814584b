"""The record of fates: sums, copies, and the items of every kind."""

from collections import Counter

import numpy as np
import pytest

from firmware_protocol.device.fates import Counts, Fates
from firmware_protocol.device.items import Items, Numbers, Reading, ReadingKind
from firmware_protocol.events import empty_edges, empty_events
from firmware_protocol.imu_samples import no_samples

ITEMS = Items(
    empty_events(5), empty_edges(2), readings=tuple(Reading(ReadingKind.IMU, no_samples(1)) for _ in range(3))
)


@pytest.mark.parametrize("fate", [name for name in vars(Counts()) if name not in ("offered", "added")])
def test_each_fate_belongs_to_the_sum(fate):
    assert Counts(offered=3, **{fate: 3}).balanced
    assert Counts(offered=2, added=1, **{fate: 3}).balanced
    assert not Counts(offered=3, **{fate: 2}).balanced


@pytest.mark.parametrize("fate", ["flushed", "delivered", "lost_on_link"])
def test_items_that_leave_have_one_fate_of_their_kind(fate):
    fates = Fates(offered=5, edges=Counts(offered=2), readings={"imu": Counts(offered=3)})
    fates.take(ITEMS)
    every = (fates, fates.edges, fates.readings["imu"])
    assert [one.queued for one in every] == [5, 2, 3]
    assert fates.all_queued == 10
    fates.leave(ITEMS, fate)
    assert [getattr(one, fate) for one in every] == [5, 2, 3]
    assert fates.all_queued == 0
    assert all(one.balanced for one in every)


@pytest.mark.parametrize("fate", ["dropped_fifo", "flushed"])
def test_items_dropped_while_they_wait_have_one_fate_whatever_their_kind(fate):
    fates = Fates(offered=5, edges=Counts(offered=2), readings={"imu": Counts(offered=3)})
    fates.drop(ITEMS.numbers, fate)
    every = (fates, fates.edges, fates.readings["imu"])
    assert [getattr(one, fate) for one in every] == [5, 2, 3]
    assert all(one.balanced for one in every)
    assert fates.all_queued == 0


def test_a_copy_has_the_items_that_wait_and_does_not_change():
    fates = Fates(offered=7)
    fates.of(ReadingKind.FRAMES).offered = 4
    now = fates.waiting(Numbers(7, 1, Counter({ReadingKind.FRAMES: 4})))
    assert now == Fates(offered=7, queued=7, edges=Counts(queued=1), readings={"frames": Counts(offered=4, queued=4)})
    assert not now.edges.balanced  # an edge that nothing offered
    fates.take(ITEMS)
    fates.of(ReadingKind.FRAMES).offered += 1
    assert (now.queued, now.readings["frames"].offered) == (7, 4)
    assert np.array_equal(list(now.readings), ["frames"])
