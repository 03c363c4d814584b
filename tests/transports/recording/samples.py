"""Events that are hard to keep: gaps longer than a wrap of EVT3, corners of the sensor, many at the same time."""

import numpy as np

from firmware_protocol.events import EDGE, EVENT, EdgeKind, make_edges
from firmware_protocol.recordings.part import Facts, Part
from transports.recording.files import RecordingFile
from transports.recording.format import FORMATS

SIZE = (346, 260)
UNIX_US = 1_700_000_000_123_000


def sample_events(count=20_000, seed=3):
    rng = np.random.default_rng(seed)
    events = np.zeros(count, EVENT)
    steps = rng.integers(0, 200, count)
    steps[[0, 1000, 5000, count - 1]] = [20_000_000, 17_000_000, 0, 60_000_000]
    events["t"] = np.cumsum(steps)
    events["x"], events["y"] = rng.integers(0, 346, count), rng.integers(0, 260, count)
    events["on"] = rng.random(count) < 0.5
    events[1:5]["x"], events[1:5]["y"] = [0, 345, 0, 345], [0, 0, 259, 259]
    return events


def sample_edges(events):
    return make_edges(events["t"][10:-10:3400][:6], [EdgeKind.RISING, EdgeKind.FALLING] * 3)


def write(path, name, events, edges=None, unix_us=UNIX_US, piece=999):
    """Write events, and edges before the piece that holds their time, as a link hands them over."""
    file = RecordingFile(path, FORMATS[name], Facts(SIZE, "DAVIS346_00000346", unix_us))
    edges = np.zeros(0, EDGE) if edges is None else edges
    for start in range(0, len(events), piece):
        part = events[start : start + piece]
        n = int(np.searchsorted(edges["t"], part["t"][-1], "right"))
        file.write(Part(part, edges[:n]))
        edges = edges[n:]
    file.close()
    return file
