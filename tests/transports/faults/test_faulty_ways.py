"""The places of faults, with ports and buses of a few lines: nothing is lost that no fault took."""

import asyncio

import numpy as np
import pytest

from firmware_protocol.can_frames.frame import BitRates, Frame
from firmware_protocol.events import EVENT, empty_edges
from firmware_protocol.instrument.instrument import Outgoing
from firmware_protocol.packets.addresses import Message, MessageKind
from transports.can_bus.bus import BusDown, CanBus, TimedFrame
from transports.can_bus.faulty_bus import BusFaults, FaultyBus
from transports.faults.bus import (
    BabblingIdiot,
    BusOff,
    Callbacks,
    DeadBus,
    FrameTracker,
    Load,
    QueuedFrame,
    RepeatedFrames,
)
from transports.faults.faulty_line import FaultyLine
from transports.faults.line import LostBytes, Stall, WrongBaud
from transports.faults.script import FaultPlan

DATA = np.random.default_rng(3).bytes(5000)
FRAME = Frame(0x1A2, bytes(8))


def line():
    return FaultyLine(FaultPlan("line"), "ccsds-cobs", 300_000.0, lambda outgoing: None)


def pour(faulty, took, room):
    """Write all of DATA through a port that has room for a few bytes at a time."""

    def port(data):
        took.append(data[:room])
        return len(data[:room])

    at = 0
    while at < len(DATA):
        at += faulty.write(DATA[at : at + 150], port)
    return port


@pytest.mark.parametrize("room", [1, 7, 150])
def test_a_port_without_room_gets_every_byte_in_order(room):
    faulty, took = line(), []
    faulty.inject(WrongBaud(ratio=1.0, for_s=1.0))
    faulty.advance(1000, b"")
    port = pour(faulty, took, room)
    faulty.advance(2_000_000, b"")
    while not faulty.flush(port):
        pass
    assert b"".join(took) == DATA


def test_the_last_byte_at_a_wrong_baud_rate_comes_when_the_line_idles():
    faulty, took = line(), []
    faulty.inject(WrongBaud(ratio=0.9, for_s=0.1))
    assert faulty.write(b"\x0f", lambda data: took.append(data) or len(data)) == 1
    faulty.advance(100_000, b"")
    faulty.flush(lambda data: took.append(data) or len(data))
    assert b"".join(took) == b"\x87"  # bits 1 2 3 5 6 7 8 of those sent, and the stop bit


def test_a_stall_takes_nothing_until_it_is_over():
    faulty, took = line(), []
    faulty.inject(Stall(for_s=0.1))
    assert faulty.write(DATA, lambda data: len(data)) == 0
    faulty.advance(100_000, b"")
    pour(faulty, took, 150)
    assert b"".join(took) == DATA


def test_a_fault_that_is_ended_by_hand_ends_once_and_alone():
    faulty, took = line(), []
    faulty.inject(Stall(for_s=100.0))
    faulty.inject(LostBytes(rate=1e-9, count=0, for_s=100.0))
    faulty.advance(50_000, b"")
    assert not any(faulty.end(number) for number in (0, 3, -1))
    assert faulty.end(1)
    faulty.advance(50_000, b"")
    assert [record.ended_us for record in faulty.records] == [50_000, None]
    assert not faulty.end(1)
    pour(faulty, took, 150)
    assert b"".join(took) == DATA


def test_what_waits_for_a_reader_that_left_is_not_for_the_next_one():
    faulty, took = line(), []
    faulty.inject(LostBytes())
    faulty.write(DATA[:100], lambda data: 0)
    faulty.drop()
    faulty.advance(0, b"")
    pour(faulty, took, 150)
    assert b"".join(took) == DATA


class FewLines(CanBus):
    """A bus that takes frames while there is room."""

    def __init__(self):
        self.opened, self.frames, self.room, self.down = 0, [], 1000, False

    async def open(self):
        self.opened += 1
        self.down = False

    def send(self, frame, *, urgent=False):
        if self.down:
            raise BusDown("down")
        if len(self.frames) >= self.room:
            return False
        self.frames.append(frame)
        return True

    def take(self):
        if self.down:
            raise BusDown("down")
        return [TimedFrame(FRAME, 1)]

    async def close(self):
        self.down = True

    @property
    def address(self):
        return "a few lines"


class Fates:
    """Remembers what it is told of loads."""

    def __init__(self):
        self.arrived, self.lost = [], []
        self.tell = Callbacks(self.arrived.append, self.lost.append)


def bus():
    faults = BusFaults(FaultPlan("can"), BitRates(), None)
    return FaultyBus(FewLines(), 0, faults), faults


def test_a_controller_that_is_off_comes_back_on_the_same_bus_and_a_bus_that_broke_is_opened():
    b, faults = bus()
    inner = b._bus
    asyncio.run(b.open())
    faults.inject(BusOff(for_s=0.1))
    for attempt in (lambda: b.post(QueuedFrame(FRAME)), b.take, lambda: asyncio.run(b.open())):
        with pytest.raises(BusDown, match="bus-off"):
            attempt()
    faults.advance(100_000)
    asyncio.run(b.open())
    assert inner.opened == 1
    assert b.post(QueuedFrame(FRAME))
    inner.down = True
    asyncio.run(b.open())
    assert inner.opened == 2


def test_a_dead_bus_hears_and_is_heard_by_nobody():
    b, faults = bus()
    assert b.has_listeners
    assert len(b.take()) == 1
    faults.inject(DeadBus(for_s=0.1))
    assert not b.has_listeners
    assert b.take() == []
    faults.advance(100_000)
    assert b.has_listeners


def test_a_babbling_node_asks_for_its_share_of_the_bus():
    b, faults = bus()
    faults.inject(BabblingIdiot(for_s=1.0, identifier=0x100, load=0.25))
    inner = b._bus
    for ms in range(101):
        b.babble(ms * 1_000_000)
    busy_ns = len(inner.frames) * 131_000  # 131 bits of a frame of eight zero bytes at 1 Mbit/s
    assert busy_ns == pytest.approx(0.25 * 100_000_000, rel=0.1)
    assert {frame.identifier for frame in inner.frames} == {0x100}


def load(n):
    return Load(np.zeros(n, EVENT), empty_edges(), 0)


def message():
    return Outgoing(message=Message(MessageKind.EVENTS, b"", 0))


def test_a_frame_that_comes_twice_counts_once_however_late():
    b, faults = bus()
    fates, inner = Fates(), b._bus
    tracker = FrameTracker(fates.tell)
    faults.inject(RepeatedFrames())
    inner.room = 1
    assert b.post(QueuedFrame(FRAME, message=tracker.message(load(3))))
    tracker.left(message())
    assert len(fates.arrived) == 1
    inner.room = 10
    b.take()
    assert len(inner.frames) == 2
    assert (len(fates.arrived), len(fates.lost)) == (1, 0)


def test_a_message_given_up_has_no_other_fate():
    fates = Fates()
    tracker = FrameTracker(fates.tell)
    first, second = tracker.message(load(1)), tracker.message(load(2))
    first.arrived(FRAME)
    tracker.dropped()
    second.gone()
    third = tracker.message(load(3))
    tracker.left(message())
    assert (fates.arrived, fates.lost) == ([], [])
    third.gone()
    assert [len(each.events) for each in fates.lost] == [3]


def test_a_bus_that_goes_away_takes_what_waits_for_it():
    b, faults = bus()
    fates, inner = Fates(), b._bus
    tracker = FrameTracker(fates.tell)
    faults.inject(RepeatedFrames(rate=0.001))
    inner.room = 0
    assert b.post(QueuedFrame(FRAME, message=tracker.message(load(3))))
    assert not b.post(QueuedFrame(FRAME))
    tracker.left(message())
    b.drop()
    assert [len(each.events) for each in fates.lost] == [3]
