"""A timestamp reset of one camera reaches the other over the cable between them, with the same zero of time."""

import numpy as np
import pytest
from davis_host import RUN, Host, steady

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.fx3.registers import SystemInfo
from transports.link.edges import EdgeRing
from transports.link.feed import Feed, Timing
from transports.link.rings import EventRing


class Side:
    """One camera with its host, its ring and its feed."""

    def __init__(self, *, master, cable):
        system = SystemInfo(timestamp_master=master)
        self.camera = Davis346(Davis346Settings(start_delay_us=300_000, system=system))
        self.host = Host(self.camera)
        self.ring = EventRing()
        timing = Timing(sync_out=(cable,)) if master else Timing(sync_in=cable)
        self.feed = Feed(self.camera, self.ring, timing)
        self.host.write_all(RUN)

    def go(self, until_us, events=None):
        if events is not None:
            self.ring.push(events)
        self.ring.publish(until_us)
        self.feed.feed(until_us, 1 << 16)


@pytest.fixture
def pair():
    cable = EdgeRing()
    return Side(master=True, cable=cable), Side(master=False, cable=cable)


def after_reset(side):
    decoded = side.host.decoded()
    assert len(decoded.resets) == 1
    return decoded.since_reset().events


@pytest.mark.parametrize("slave_us", [1000, 5000, 9000])
def test_both_clocks_are_zero_at_the_same_instant(pair, slave_us):
    """Whether the slave is behind the master, level with it or ahead when the reset comes."""
    master, slave = pair
    assert master.host.read(6, 2) == 1
    assert slave.host.read(6, 2) == 0
    slave.go(slave_us)
    master.go(5000)
    master.host.reset_timestamps()
    master.go(9500)
    slave.go(9500)
    events = steady(200, start_us=10_000, step_us=7)
    for side in pair:
        side.go(20_000, events)
    expected = events["t"] - np.uint64(5000)
    for side in pair:
        assert after_reset(side)["t"].tolist() == expected.tolist()


def test_a_slave_that_is_not_running_is_left_alone(pair):
    master, slave = pair
    slave.host.write(0, 0, 0)
    master.host.reset_timestamps()
    for side in pair:
        side.go(1000)
    assert len(slave.host.decoded().resets) == 0


def test_a_reset_of_the_slave_alone_stays_with_it(pair):
    master, slave = pair
    slave.host.reset_timestamps()
    for side in (slave, master):
        side.go(1000)
    assert len(slave.host.decoded().resets) == 1
    assert len(master.host.decoded().resets) == 0
