"""Faults of single items: loss, repetition and delay, the path of an item, and refused faults."""

import numpy as np
import pytest

from firmware_protocol.can_frames.frame import BitRates
from transports.can_bus.faulty_bus import BusFaults
from transports.faults.bus import LostFrames
from transports.faults.datagrams import FaultyDatagrams, LateDatagrams, LostDatagrams
from transports.faults.kinds import Delay, Loss, Repetition
from transports.faults.line import LostBytes
from transports.faults.script import FaultPlan, Faults, pass_through
from transports.gige.packet_faults import FaultyPackets
from transports.link.deliveries import Deliveries
from transports.link.pacing import FakeClock
from transports.link.rings import EventRing

RATES = BitRates()


def random():
    return np.random.default_rng(1)


def late(overtaken_by, **fault):
    return Delay(LateDatagrams(**fault), random(), overtaken_by)


def test_a_late_item_follows_the_items_that_overtake_it():
    stage = late(2, count=2)
    assert [stage.change(n) for n in range(5)] == [[], [], [2], [3, 0, 1], [4]]
    assert (stage.hits, stage.touched, stage.over) == (2, 2, True)


def test_a_delay_is_not_over_while_it_holds_an_item():
    stage = late(3)
    for n in range(2):
        stage.change(n)
        assert not stage.over
    assert stage.finish() == [0]
    assert stage.finish() == []


def test_the_first_item_is_lost_or_repeated_by_default():
    lost, repeated = Loss(LostDatagrams(), random()), Repetition(LostDatagrams(), random())
    assert [lost.change(n) for n in range(2)] == [[], [1]]
    assert [repeated.change(n) for n in range(2)] == [[0, 0], [1]]


def test_an_item_passes_the_stages_in_order_and_each_hit_is_recorded_before_its_fate():
    faults = Faults(FaultPlan(), lambda fault, _: {1: Repetition, 2: Loss}[fault.count](fault, random()))
    faults.inject(LostDatagrams(count=1))
    faults.inject(LostDatagrams(count=2, rate=1.0))
    steps = []

    def fate(stage, item, passed):
        steps.append((type(stage), item, passed))
        faults.lose(len(passed) == 0, 0)

    assert pass_through(faults, "a", 7, fate) == []
    assert steps == [(Repetition, "a", ["a", "a"]), (Loss, "a", []), (Loss, "a", [])]
    assert [(record.hits, record.events_lost) for record in faults.records] == [(1, 0), (2, 2)]


def test_a_carrier_refuses_the_faults_of_another():
    with pytest.raises(ValueError, match="'lost_bytes' is no fault of a CAN bus"):
        BusFaults(FaultPlan(), RATES, Deliveries(EventRing(16), FakeClock())).inject(LostBytes())
    with pytest.raises(ValueError, match="'lost_frames' is no fault of packets in datagrams"):
        FaultyDatagrams(FaultPlan(), lambda _: None).inject(LostFrames())
    with pytest.raises(ValueError, match="'lost_frames' is no fault of a GigE Vision stream"):
        FaultyPackets(FaultPlan()).inject(LostFrames())
