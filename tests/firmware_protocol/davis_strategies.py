"""Hypothesis strategies for event streams."""

from itertools import pairwise

import numpy as np
from hypothesis import strategies as st

from tests.made_events import events_at

# Steps that meet every case: same time, next microsecond, across one wrap, exactly one wrap, many wraps.
STEPS_US = st.one_of(
    st.just(0),
    st.just(1),
    st.integers(0, 40),
    st.sampled_from([32766, 32767, 32768, 32769, 65536, 98304]),
    st.integers(0, 2_000_000),
)


@st.composite
def streams(draw, max_size=60, width=346, height=260, first_us=0):
    """Sorted events; rows often repeat."""
    steps = draw(st.lists(STEPS_US, max_size=max_size))
    events = events_at(first_us + np.cumsum(np.array(steps, np.int64)))
    rows = st.one_of(st.integers(0, height - 1), st.integers(0, min(1, height - 1)))
    for name, values in (("x", st.integers(0, width - 1)), ("y", rows), ("on", st.booleans())):
        events[name] = draw(st.lists(values, min_size=len(steps), max_size=len(steps)))
    return events


def cut(sequence, cuts):
    """Split at the given positions (any order, any value)."""
    edges = [0, *sorted(min(c, len(sequence)) for c in cuts), len(sequence)]
    return [sequence[a:b] for a, b in pairwise(edges)]
