"""Damaged messages of a PTP master: the slave's memory and its measures stay bounded, and it finds its master again.

EVSTIM_HOSTILE_PTP=1e6 python -m pytest tests/hostile/test_ptp.py
"""

import os
import random

from firmware_protocol.ptp.slave import PortState
from tests.firmware_protocol.ptp_network import Master, Network, S
from tests.hostile.mutation import damaged_bytes

COUNT = int(float(os.environ.get("EVSTIM_HOSTILE_PTP", "4000")))
SECONDS = 1 / 16
FIELDS = [
    *range(6, 20),
    *range(32, 54),
]  # of messages that are still the master's: flags, corrections, intervals, times


def _damaged(good, draw):
    if draw.random() < 0.5:
        return damaged_bytes(good, draw)
    data = bytearray(good)
    for place in draw.sample(FIELDS, 3):
        data[min(place, len(data) - 1)] = draw.randrange(256)
    return bytes(data)


def test_damaged_messages_of_the_master_leave_a_clock_that_goes_on():
    draw, master = random.Random(3), Master()
    network = Network(master)
    slave = network.slave
    network.run(10)
    for _ in range(COUNT // 4):
        network.run(SECONDS)
        for good in (master.announce(), *master.syncs(network.true_ns), master.response(bytes(44), network.true_ns)):
            late_ns = draw.randrange(1000)
            slave.receive(_damaged(good, draw), network.local_ns(network.true_ns + late_ns))
        assert abs(slave.status.delay_ns) <= S
        assert len(slave._masters) <= 5
        assert len(slave._servo._samples) < 200
        assert slave.timebase is None or abs(slave.timebase.rate_ppb) <= 500_000
    assert slave.counts["ptp syncs measured"] > COUNT // 16
    network.run(400)  # a damaged announce can stand for four intervals of up to 64 s
    assert slave.state == PortState.SLAVE
    assert abs(network.error_ns(master)) < 1000
