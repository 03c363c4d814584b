"""Streams of events to make blocks of, drawn by kind and seed."""

import numpy as np
from hypothesis import strategies as st

from tests.made_events import events_at
from tests.made_events import events_of as events_of

SIZES = [(346, 260), (1, 1), (7, 3), (1, 4096), (4096, 1), (4096, 4096), (640, 480)]
TICKS = [1, 10, 100, 1000]


def stream(size, n, span_us, seed, start_us=0):
    """Uniform noise: `n` events anywhere within `span_us`."""
    rng = np.random.default_rng(seed)
    times = start_us + np.sort(rng.integers(0, span_us + 1, n))
    return events_at(times, x=rng.integers(0, size[0], n), y=rng.integers(0, size[1], n), on=rng.integers(0, 2, n))


def _crowded(events, size, rng):
    """Bring the events together: a small patch, runs along rows, one pixel, one polarity."""
    kind = rng.integers(0, 5)
    if kind == 1:
        events["x"], events["y"] = events["x"] % max(1, size[0] // 20), events["y"] % max(1, size[1] // 20)
    elif kind == 2:
        at = rng.integers(0, size[0] * size[1]) + np.cumsum(rng.integers(0, 4, len(events)))
        events["x"], events["y"] = at % size[0], at // size[0] % size[1]
    elif kind == 3:
        events["x"], events["y"] = size[0] - 1, size[1] - 1
    if rng.integers(0, 3) == 0:
        events["on"] = rng.integers(0, 2)
    return events


@st.composite
def streams(draw, most=250):
    """Return (size, events)."""
    size = draw(st.sampled_from(SIZES))
    n = draw(st.integers(1, most))
    span_us = draw(st.sampled_from([0, 3, 500, 20_000, 2**31 - 1, 2**40]))
    start_us = draw(st.sampled_from([0, 1_000_003, 2**32 - 300, 2**40 + 5]))
    seed = draw(st.integers(0, 2**32 - 1))
    return size, _crowded(stream(size, n, span_us, seed, start_us), size, np.random.default_rng(seed))


def in_order(events, tick_us):
    """What a receiver gets, the slow and obvious way."""
    rows = [(t - t % tick_us, x, y, on) for t, x, y, on in events.tolist()]
    return events_of(*sorted(rows, key=lambda row: (row[0], row[2], row[1])))


def blocks_of(encoder, events):
    """All blocks of `events` as (bytes, their events)."""
    blocks = []
    while len(events):
        data, taken = encoder.encode(events)
        assert 1 <= taken <= len(events)
        blocks.append((data, events[:taken]))
        events = events[taken:]
    return blocks
