"""Waiting for what another process or thread does."""

import time


def until(condition, timeout_s=120.0):
    """Return the first value of the condition that is true; fail when there is none in time."""
    deadline_s = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < deadline_s, "it did not happen"
        time.sleep(0.01)
    return value
