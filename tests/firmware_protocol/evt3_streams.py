"""Events that EVT words code in every way, and other packages' readings of the words."""

import evt3
import numpy as np
from hypothesis import strategies as st

from firmware_protocol.events import EVENT
from firmware_protocol.evt.words import evt3_header

SIZE = (1280, 720)
WRAP_US = 1 << 24

steps_us = st.one_of(st.just(0), st.integers(0, 3), st.integers(0, 10_000), st.integers(0, 6 * WRAP_US))
long_steps_us = st.one_of(st.integers(0, 3), st.integers(0, WRAP_US), st.integers(0, 5 * 3_600_000_000))


@st.composite
def streams(draw, steps=steps_us, width=SIZE[0], max_groups=8):
    """Return events (n,) EVENT in groups of one time and row, columns rising or not, near each other."""
    groups = draw(st.lists(st.tuples(steps, st.integers(1, 40), st.integers(0, 1 << 32)), max_size=max_groups))
    parts, t = [], 0
    for step_us, count, seed in groups:
        t += step_us
        parts.append(_group(t, count, width, np.random.default_rng(seed)))
    return np.concatenate([np.zeros(0, EVENT), *parts])


def _group(t, count, width, rng):
    gaps = rng.choice([1, 1, 1, 1, 2, 5] if rng.random() < 0.5 else [1, 1, 1, 2, 5, 0, -3], count)
    group = np.zeros(count, EVENT)
    group["t"], group["y"], group["on"] = t, rng.integers(0, SIZE[1]), rng.random() < 0.5
    group["x"] = np.clip(rng.integers(0, width) + np.cumsum(gaps), 0, width - 1)
    if rng.random() < 0.3:
        group["on"][rng.integers(0, count)] ^= True
    return group


def as_events(t, x, y, on):
    events = np.zeros(len(t), EVENT)
    for name, values in zip(EVENT.names, (t, x, y, on), strict=True):
        events[name] = np.asarray(values) > 0 if name == "on" else np.asarray(values)
    return events


def by_evt3(data):
    read = evt3.decode_bytes(evt3_header(SIZE) + data)
    return as_events(read.t, read.x, read.y, read.p)
