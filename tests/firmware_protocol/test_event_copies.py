"""Copies of event arrays keep every byte and share none."""

import numpy as np
from davis_host import steady

from firmware_protocol.events import EVENT, copy_events, empty_events, join_events


def test_a_copy_is_equal_and_apart():
    events = steady(100)
    copy = copy_events(events[10:20])
    events["x"] = 0
    assert np.array_equal(copy, steady(100)[10:20])
    assert copy.dtype == EVENT


def test_strided_events_are_copied_too():
    assert np.array_equal(copy_events(steady(100)[::3]), steady(100)[::3])


def test_joining_skips_what_is_empty():
    events = steady(100)
    joined = join_events([empty_events(), events[:40], empty_events(), events[40:]])
    assert np.array_equal(joined, events)
    assert joined.dtype == EVENT
    assert len(join_events([])) == len(join_events([empty_events()])) == 0
