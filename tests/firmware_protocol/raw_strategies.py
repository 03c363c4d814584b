"""Streams of raw frames whose clock is far from zero, jumps, and counts in changing ticks."""

import numpy as np
from hypothesis import strategies as st

from firmware_protocol.can_frames.dbc import Identifiers
from firmware_protocol.can_frames.raw_stream import RawSender, RawSettings
from firmware_protocol.events import EVENT

IDS = Identifiers.of_node(0x22)
TICKS_US = (1, 10, 100, 1000)

gaps = st.lists(st.sampled_from([0, 1, 126, 127, 5000, 32_767, 32_768, 40_000, 2_000_000]), min_size=1, max_size=12)
times = st.one_of(
    st.integers(0, 1 << 41), st.integers(0, 40).flatmap(lambda n: st.integers(-3, 3).map(lambda d: n + d))
)
near_turns = st.integers(1, 1 << 12).flatmap(lambda n: st.integers(-40_000, 40_000).map(lambda d: (n << 30) + d))


@st.composite
def jumping_streams(draw):
    """Return (time-ordered parts of events, tick of each): between two parts the time jumps anywhere."""
    parts = []
    for _ in range(draw(st.integers(1, 5))):
        steps = draw(gaps)
        events = np.zeros(len(steps), EVENT)
        start = max(0, draw(st.one_of(times, near_turns)))
        events["t"] = start + np.cumsum(steps)
        rng = np.random.default_rng(draw(st.integers(0, 99)))
        events["x"], events["y"], events["on"] = rng.integers(0, [512, 512, 2], (len(steps), 3)).T
        parts.append((events, draw(st.sampled_from(TICKS_US))))
    return parts


def frames_of(parts, *, fd):
    """Return the frames of `parts`, and of each frame the events that a receiver has to give, cut to the tick."""
    sender = RawSender(RawSettings(IDS.events, IDS.epoch, parts[0][1], fd=fd, clock=IDS.clock))
    frames, expected, tick_us = [], [], parts[0][1]
    for events, wanted in parts:
        if wanted != tick_us:
            tick_us = wanted
            sender.set_tick(tick_us)
        for packed in sender.pack(events):
            cut = packed.events.copy()
            cut["t"] = cut["t"] // tick_us * tick_us
            frames.append(packed.frame)
            expected.append(cut)
    return frames, expected
