"""All streams of a camera: tables of a rig, what a client is asked for, and whether it saw what was delivered."""

import numpy as np

from firmware_protocol.events import EdgeKind
from tests.guest.comparison import assert_same

__all__ = ["ASKED", "FREE", "STREAMS", "STREAMS_240C", "assert_same_frames", "assert_same_streams", "place_of"]

ASKED = ("--imu", "--frames", "--triggers")
FREE = """
[run]
pace = "free"  # frames are ten times the bytes of the events: a busy machine cannot take them in real time
"""
STREAMS = """
[camera.clock]
drift_ppm = 50

[camera.imu]
gyroscope_bias_deg_s = [30.0, -20.0, 0.5]

[camera.frames]
sensitivity_dn_ms = 20.0  # dv-processing exposes for 20 ms

[trigger]
period_ms = 10.0
kind = "pulse"
pulse_us = 300
latency_us = 37
jitter_us = 5
"""
STREAMS_240C = STREAMS.replace("[camera.imu]", '[camera.imu]\nunit = "mpu_6050"')
COLUMNS = [f"accelerometer_{a}" for a in "xyz"] + ["temperature"] + [f"gyroscope_{a}" for a in "xyz"]
KNOWN_PLACE = 100  # events that no other part of a stream repeats


def assert_same_streams(driver, seen, delivered, *, whole=True):
    """Assert that events, edges and samples are as delivered, and return by how much a client's time is later, in us.

    With `whole`, the client kept all since device time was zero; without, a part in the middle.
    """
    events = delivered.last
    place = 0 if whole else place_of(seen.events, events)
    offset_us = int(seen.events["t"][0]) - int(events["t"][place]) if driver.adds_host_time or not whole else 0
    assert_same(seen.events, events[place:], offset_us=offset_us)
    assert_same_edges(seen, delivered, offset_us, least=50 if whole else 6)
    assert_same_samples(seen, delivered, offset_us, least=100 if whole else 20)
    return offset_us


def place_of(seen, delivered):
    """Return the index in `delivered` (m,) at which `seen` (n,) begins, in a time of its own."""
    start = seen[:KNOWN_PLACE]
    for place in np.flatnonzero((delivered["x"] == start["x"][0]) & (delivered["y"] == start["y"][0])):
        there = delivered[place : place + len(start)]
        same = len(there) == len(start) and all((there[name] == start[name]).all() for name in ("x", "y", "on"))
        if same and np.array_equal(there["t"] - there["t"][0], start["t"] - start["t"][0]):
            return int(place)
    raise AssertionError(f"nothing that was delivered begins as what was seen: {start[:5].tolist()}")


def assert_same_edges(seen, delivered, offset_us, least):
    edges, count = delivered.edges[delivered.edge_resets[-1] :], len(seen.triggers)
    assert count >= least
    edges = edges[np.searchsorted(edges["t"], seen.triggers["t"][0] - np.uint64(offset_us)) :]
    assert (seen.triggers["t"] - np.uint64(offset_us)).tolist() == edges["t"][:count].tolist()
    assert seen.triggers["kind"].tolist() == edges["kind"][:count].tolist()
    assert set(seen.triggers["kind"].tolist()) == set(EdgeKind)


def assert_same_samples(seen, delivered, offset_us, least):
    imu, count = delivered.imu[delivered.imu_resets[-1] :], len(seen.imu_t)
    assert count >= least
    first = int(np.searchsorted(imu["t"], seen.imu_t[0] - offset_us))
    told = imu[first : first + count]
    assert (seen.imu_t - offset_us).tolist() == told["t"].astype(np.int64).tolist()
    values = np.column_stack([told[name] for name in COLUMNS]).astype(np.float64)
    np.testing.assert_allclose(seen.imu, values, rtol=4e-7, atol=1e-9)  # a few roundings of float32
    assert abs(values[:, 1].mean() + 1) < 0.2  # at rest on the bench, y down, it is held up with 1 g


def assert_same_frames(driver, seen, delivered, offset_us):
    frames = delivered.frames[delivered.frame_resets[-1] :]
    times = seen.frame_t - offset_us
    assert len(times) >= 3
    ours = frames["t"] if driver.adds_host_time else frames["exposure_end"]
    first = int(np.argmin(np.abs(ours - times[0])))
    if driver.adds_host_time:  # the others date a frame by its end, which no record has
        assert times.tolist() == ours[first : first + len(times)].tolist()
    for k, pixels in enumerate(seen.frames):
        expected = as_seen(driver, frames["pixels"][first + k].astype(np.int64))
        most = 0 if driver.name == "nd" else 1
        assert np.abs(pixels.astype(np.int64) - expected).max() <= most, k


def as_seen(driver, reset_less_signal):
    """What a driver's picture is, of pixels of 10 bits, within a step of 8 bits where it rounds."""
    return reset_less_signal << 6 if driver.name == "nd" else np.minimum(reset_less_signal / 4, 255)
