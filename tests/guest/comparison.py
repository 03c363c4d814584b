"""Does a client's view equal what was delivered, event by event?"""

import numpy as np

from firmware_protocol.events import EVENT, make_edges

__all__ = ["assert_same", "load_frames", "load_imu", "load_seen", "load_triggers"]


def load_seen(path):
    """Read a client's arrays as EVENT (n,), in the client's time."""
    with np.load(path) as arrays:
        seen = np.empty(len(arrays["t"]), EVENT)
        for name in ("t", "x", "y", "on"):
            seen[name] = arrays[name]
    return seen


def load_triggers(path):
    """Read a client's triggers as EDGE (n,), in the client's time."""
    with np.load(path) as arrays:
        return make_edges(arrays["trigger_t"], arrays["trigger_kind"])


def load_imu(path):
    """Read a client's samples: times (n,) in the client's time, and values (n, 7) as `collecting` describes them."""
    with np.load(path) as arrays:
        return arrays["imu_t"], arrays["imu"]


def load_frames(path):
    """Read a client's frames: times (n,) in the client's time, and pixels (n, height, width) as the driver has them."""
    with np.load(path) as arrays:
        return arrays["frame_t"], arrays["frames"]


def assert_same(seen, delivered, *, offset_us):
    """Assert that `seen` (n,) is how `delivered` (m,) begins, with times later by `offset_us`."""
    assert len(seen) <= len(delivered), f"{len(seen)} events seen, only {len(delivered)} delivered"
    expected = delivered[: len(seen)].copy()
    expected["t"] += np.uint64(offset_us)
    wrong = np.flatnonzero(seen != expected)
    if len(wrong):
        i = wrong[0]
        around = slice(max(0, i - 2), i + 3)
        raise AssertionError(
            f"{len(wrong)} of {len(seen)} events differ, the first at {i}:\n"
            f"seen      {seen[around].tolist()}\ndelivered {expected[around].tolist()}"
        )
