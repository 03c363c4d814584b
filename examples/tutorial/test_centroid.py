"""Tests of the tutorial's flight code, for CI: a correct line, and one that is unplugged for a second."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from centroid import Centroid

from evstim.testing.running_rig import RunningRig

MIDDLE = pytest.approx((172.5, 129.5), abs=60.0)  # Eros is in the middle, 200 pixels long, and lit from one side


def poll_until(centroid: Centroid, is_done: Callable[[], bool], within_s: float = 30.0) -> None:
    """Poll until the condition holds; fail where it does not hold in time."""
    end_s = time.monotonic() + within_s
    while not is_done():
        assert time.monotonic() < end_s
        centroid.poll()


@pytest.mark.rig("asteroid.toml", seed=7)
def test_the_centroid_survives_an_unplugged_line(evstim_rig: RunningRig) -> None:
    """A position, then none while the line is away, then a position again."""
    centroid = Centroid(evstim_rig.address)
    poll_until(centroid, lambda: centroid.windows >= 3)
    assert centroid.is_fresh
    assert (centroid.x, centroid.y) == MIDDLE

    evstim_rig.inject("unplugged", for_s=1.0)
    poll_until(centroid, lambda: centroid.lost_lines == 1)
    assert not centroid.is_fresh

    poll_until(centroid, lambda: centroid.is_fresh)
    assert (centroid.x, centroid.y) == MIDDLE
