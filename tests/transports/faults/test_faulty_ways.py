"""The places of faults, with ports and buses of a few lines: nothing is lost that no fault took."""

import numpy as np
import pytest

from firmware_protocol.can_frames.frame import BitRates, Frame
from firmware_protocol.instrument.instrument import Outgoing
from firmware_protocol.packets.addresses import Message, MessageKind
from transports.can_bus.bus import BusDown, CanBus, TimedFrame
from transports.can_bus.faulty_bus import BusFaults, FaultyBus
from transports.faults.faulty_line import FaultyLine
from transports.faults.line import LostBytes, Stall, WrongBaud
from transports.faults.script import FaultPlan
from transports.link.deliveries import Deliveries
from transports.link.pacing import FakeClock
from transports.link.rings import EventRing

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


def bus():
    faults = BusFaults(FaultPlan("can"), BitRates(), Deliveries(EventRing(16), FakeClock()))
    return FaultyBus(FewLines(), 0, faults), faults


def message():
    return Outgoing(message=Message(MessageKind.EVENTS, b"", 0))
