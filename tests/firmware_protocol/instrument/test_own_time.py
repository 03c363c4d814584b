"""The camera's own time: an offset to stream time, with bounds, and never backward stream time."""

import pytest

from firmware_protocol.instrument.queue import OwnTime
from firmware_protocol.packets.housekeeping import TimeStatus

YEAR_US = 366 * 86_400 * 1_000_000


def test_time_is_set_and_runs_on():
    time = OwnTime()
    time.reach(100)
    time.set(5000)
    time.reach(150)
    time.reach(120)
    assert (time.now_us, time.own_us, time.epoch_us, time.of(100)) == (150, 5050, -4900, 5000)
    assert time.status is TimeStatus.SET


def test_a_restart_is_no_setting():
    time = OwnTime()
    time.reach(100)
    time.restart()
    assert (time.own_us, time.epoch_us, time.status) == (0, 100, TimeStatus.FREE_RUNNING)


def test_a_tick_that_began_before_the_stream_has_a_time():
    time = OwnTime()
    time.set(600)
    assert time.of((1 << 64) - 500) == 100


@pytest.mark.parametrize("t_us", [-1, (1 << 32) * 1_000_000 - YEAR_US + 1])
def test_a_time_that_leaves_no_year_is_refused(t_us):
    time = OwnTime()
    with pytest.raises(ValueError, match="leaves no year"):
        time.set(t_us)
    assert time.own_us == 0
