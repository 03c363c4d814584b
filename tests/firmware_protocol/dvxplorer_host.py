"""A host of a DVXplorer for tests: the requests that drivers send, and streams of events."""

from __future__ import annotations

import numpy as np
from davis_host import Host as DavisHost
from davis_strategies import STEPS_US
from hypothesis import strategies as st

from firmware_protocol.dvxplorer.decoder import GroupDecoder
from firmware_protocol.dvxplorer.device import Dvxplorer, DvxplorerSettings
from firmware_protocol.events import EVENT
from tests.made_events import events_at, steady

RUN = [(0, 3, 1), (9, 0, 1), (0, 1, 1), (0, 0, 1), (1, 3, 1), (5, 0x3000, 2)]
MEASURE = [(3, 2, 1), (3, 3, 1), (3, 4, 1)]


class Host(DavisHost):
    """Configures a camera and does what drivers do."""

    def new_decoder(self):
        self.decoder = GroupDecoder()


def running(writes=(), **changes):
    """A camera that streams from time zero, and its host."""
    camera = Dvxplorer(DvxplorerSettings(start_delay_us=0, **changes))
    host = Host(camera)
    host.write_all([*RUN, *writes])
    return camera, host


def scans(n, start_us=0, scan_us=197, seed=0):
    """About `n` events of scans: columns in order, each with its time, rising rows."""
    rng = np.random.default_rng(seed)
    keys = []
    for k in range(max(1, n // 500)):
        pixels = np.sort(rng.choice(640 * 480, 500, replace=False))
        pixels[::3] = pixels[::3] // 480 * 480 + rng.integers(0, 24, len(pixels[::3]))
        keys.append(np.unique(pixels) + k * 640 * 480)
    key = np.concatenate(keys)
    events = np.zeros(len(key), EVENT)
    events["x"], events["y"] = key % (640 * 480) // 480, key % 480
    events["t"] = start_us + key // (640 * 480) * scan_us + events["x"].astype(int) * scan_us // 640
    events["on"] = rng.integers(0, 2, len(key))
    return events


def scattered(n, start_us=0, step_us=1, seed=0):
    """`n` events, one each `step_us`, anywhere."""
    return steady(n, start_us, step_us, seed, (640, 480))


@st.composite
def streams(draw, max_size=60, first_us=0):
    """Sorted events in any order of pixels; times, columns and groups often repeat."""
    steps = draw(st.lists(st.one_of(st.just(0), STEPS_US), max_size=max_size))
    events = events_at(first_us + np.cumsum(np.array(steps, np.int64)))
    columns = st.one_of(st.integers(0, 639), st.integers(0, 1), st.just(639))
    rows = st.one_of(st.integers(0, 479), st.integers(0, 20), st.integers(470, 479))
    for name, values in (("x", columns), ("y", rows), ("on", st.booleans())):
        events[name] = draw(st.lists(values, min_size=len(steps), max_size=len(steps)))
    return events
