"""A slave of the Precision Time Protocol beside masters whose true time is known."""

from __future__ import annotations

import random

import pytest

from firmware_protocol.ptp.messages import Flag
from firmware_protocol.ptp.slave import PortState, Slave
from tests.firmware_protocol.ptp_network import SLAVE, Master, Network, S

UP = [PortState.LISTENING, PortState.UNCALIBRATED, PortState.SLAVE]


@pytest.mark.parametrize("two_step", [True, False])
@pytest.mark.parametrize("ppm", [-80.0, 0.0, 80.0])
def test_it_follows_a_master(two_step, ppm):
    master = Master(two_step=two_step)
    network = Network(master, ppm=ppm)
    network.run(20)
    assert network.states == UP
    assert abs(network.error_ns(master)) <= 30  # 80 ppm of the delay's turn, and a part in 10^9 of rate
    status = network.slave.status
    assert (status.state, status.locked, status.clock) == (PortState.SLAVE, True, SLAVE)
    assert (status.parent, status.grandmaster) == (master.identity, master.identity)
    assert status.delay_ns == pytest.approx(network.delay_ns, abs=5)


def test_stamps_with_noise_move_the_clock_less_than_they_vary():
    master = Master()
    network = Network(master, ppm=30.0, noise_ns=20_000)
    network.run(20)
    errors = []
    for _ in range(200):
        network.run(0.25)
        errors.append(network.error_ns(master))
    assert max(map(abs, errors)) < 20_000
    assert sum(e * e for e in errors) / len(errors) < 6_000**2  # standard deviation of one stamp: 5800 ns


def test_a_correction_is_taken_off():
    master = Master(correction_ns=3_000_000)
    network = Network(master)
    network.run(20)
    assert abs(network.error_ns(master)) <= 10


def test_one_late_sync_hardly_counts():
    master = Master()
    network = Network(master)
    network.run(20)
    for data in master.syncs(network.true_ns):
        network.slave.receive(data, network.local_ns(network.true_ns + 50_000_000))
    network.run(0.25)
    assert network.slave.state == PortState.SLAVE
    assert abs(network.error_ns(master)) < 40_000
    network.run(20)
    assert abs(network.error_ns(master)) < 100


def test_a_master_that_sets_its_time_is_followed():
    master = Master()
    network = Network(master)
    network.run(20)
    master.ahead_ns += 7 * S
    network.run(20)
    assert network.states == [*UP, PortState.UNCALIBRATED, PortState.SLAVE]
    assert abs(network.error_ns(master)) <= 30


def test_without_announces_it_listens_and_keeps_its_rate():
    master = Master()
    network = Network(master, ppm=50.0)
    network.run(20)
    master.quiet = True
    network.run(2.9)
    assert network.slave.state == PortState.SLAVE
    network.run(10)
    assert network.slave.state == PortState.LISTENING
    assert network.slave.status.parent == 0
    assert abs(network.error_ns(master)) < 200  # some parts in 10^9 for 13 s; 50 ppm would be 650 us
    master.quiet = False
    network.run(20)
    assert network.states == [*UP, *UP]


def test_the_better_of_two_masters_is_followed_and_the_other_when_it_ends():
    good, fair = Master(identity=2, priority=10), Master(identity=1, priority=20, ahead_ns=1_600_000_000 * S)
    network = Network(fair, good)
    network.run(20)
    assert network.slave.status.parent == 2
    good.quiet = True
    network.run(20)
    assert network.slave.status.parent == 1
    assert abs(network.error_ns(fair)) <= 30


def test_a_single_announce_is_not_enough():
    network = Network()
    network.run(1)
    network.slave.receive(Master().announce(), network.local_ns(network.true_ns))
    network.run(1)
    assert network.slave.state == PortState.LISTENING


def test_other_domains_own_messages_and_alternate_masters_are_ignored():
    network = Network()
    for place, value in ((4, 1), (6, Flag.ALTERNATE_MASTER >> 8), (62, 255)):  # 62: 255 steps from the grandmaster
        for _ in range(3):
            network.run(1)
            data = bytearray(Master().announce())
            data[place] = value
            network.slave.receive(bytes(data), network.local_ns(network.true_ns))
    own = Master(identity=SLAVE)
    network.masters.append(own)
    network.run(5)
    assert network.states == [PortState.LISTENING]


def test_states_of_a_port_that_is_switched_off_or_fails():
    master = Master()
    slave = Slave(SLAVE, 0, random.Random(1).random)
    assert (slave.state, slave.timebase) == (PortState.DISABLED, None)
    slave.receive(master.announce(), 1)
    assert not slave.counts
    slave.enable()
    assert slave.state == PortState.INITIALIZING
    slave.advance(1)
    assert slave.state == PortState.LISTENING
    slave.fail()
    assert slave.state == PortState.FAULTY
    slave.enable()
    assert slave.state == PortState.INITIALIZING
    network = Network(master)
    network.run(20)
    network.slave.disable()
    assert (network.slave.state, network.slave.timebase) == (PortState.DISABLED, None)


def test_a_master_cannot_fill_the_memory():
    network = Network()
    for k in range(1000):
        network.slave.receive(Master(identity=k + 1).announce(), network.local_ns(network.true_ns))
    assert len(network.slave._masters) == 5
    network.run(20)
    assert not network.slave._masters


def test_requests_follow_the_interval_of_the_master():
    for log, least, most in ((-2, 60, 110), (1, 5, 17)):
        network = Network(Master(log_request=log))
        network.run(30)
        assert least < network.slave.counts["ptp delay requests"] < most


def test_a_master_can_change_the_rate_by_500_ppm_at_most():
    network = Network(Master(), ppm=2000.0)
    network.run(20)
    assert network.slave.timebase.rate_ppb == -500_000
