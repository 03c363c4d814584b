"""A CAN link with faults: what is lost is known, and the node comes back."""

import asyncio
import itertools
from functools import partial

import can
import numpy as np
import pytest

from firmware_protocol.can_frames.canopen import NodeState, SelectorSettings
from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.events import EVENT
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.receiver.can import CanReceiver
from tests.made_events import steady
from transports.can_bus.bus import from_message, to_message
from transports.can_bus.endpoint import CanEndpoint
from transports.can_bus.kind import CanLink
from transports.can_bus.served import ServedBus
from transports.faults.bus import (
    BabblingIdiot,
    BusOff,
    ChangedFrames,
    DeadBus,
    ErrorFrames,
    LostFrames,
    ReorderedFrames,
    RepeatedFrames,
)
from transports.faults.script import FaultPlan
from transports.link.deliveries import digest_of
from transports.link.endpoint import LinkFactory
from transports.link.kind import Wiring
from transports.link.pacing import FakeClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import EventRing

ORIGIN_NS = 1_000_000_000
TICK_NS = 500_000
CHANNELS = itertools.count()
EVENTS = 600
CARRIAGES = ["raw", "isotp", "cfp"]


def stream(n, gap_us=300):
    return steady(n, step_us=gap_us)


class Bench:
    """A link on virtual buses, on a clock that the test moves, and a computer on each bus."""

    def __init__(self, faults, **more):
        self.p = CanLink(
            **{
                "interface": "virtual",
                "channel": f"faults-{next(CHANNELS)}",
                "share": 1.0,
                "flow_control": False,
                "heartbeat_ms": 50,
                "instrument": InstrumentSettings(queue_ms=60_000, housekeeping_s=0),
            }
            | more
        )
        self.clock, self.ring = FakeClock(ORIGIN_NS), EventRing(1 << 14)
        self.origin_ns = self.clock.now_ns()
        device = partial(Instrument, (346, 260), self.p.instrument)
        factory = LinkFactory(CanEndpoint, self.p, Wiring(FaultPlan("can", tuple(faults), 1)))
        self.link = Link(LinkSetup("can", self.ring, device, factory), self.clock)
        channels = [c for c in (self.p.channel, self.p.channel_b) if c]
        self.peers = [can.Bus(interface="virtual", channel=channel) for channel in channels]
        self.receiver = CanReceiver(self.p.receiver)
        self.frames = [[] for _ in channels]
        self.parts = [np.zeros(0, EVENT)]

    async def start(self, events=EVENTS):
        await self.link.endpoint.start()
        self.ring.start(self.origin_ns)
        self.ring.push(stream(events))
        self.ring.publish(10_000_000)

    async def tick(self):
        """Let the link do one round, and the computers hear."""
        self.link.tick()
        await asyncio.sleep(0)
        for bus, peer in enumerate(self.peers):
            while (message := peer.recv(0)) is not None:
                frame = from_message(message)
                self.frames[bus].append((self.clock.now_ns(), frame))
                self.receiver.push(frame, self.clock.now_ns())
                self.parts.append(self.receiver.take_events())

    async def run(self, ticks):
        for _ in range(ticks):
            self.clock.advance(TICK_NS)
            await self.tick()

    def heard(self, identifier, bus=0):
        return [(t_ns, frame) for t_ns, frame in self.frames[bus] if frame.identifier == identifier]

    @property
    def events(self):
        return np.concatenate(self.parts)

    def close(self):
        for peer in self.peers:
            peer.shutdown()


def play(faults, ticks=500, **more):
    """Run a link with these faults; return the bench and the final report."""

    async def whole():
        b = Bench(faults, **more)
        try:
            await b.start()
            await b.run(ticks)
            await b.link.close()
        finally:
            b.close()
        return b, b.link.report(final=True)

    return asyncio.run(whole())


def assert_known(b, report, sent=EVENTS):
    lost = sum(fault.events_lost for fault in report.faults)
    assert report.camera.delivered == sent
    assert report.dropped == lost
    assert len(b.events) == report.delivered == sent - lost


@pytest.mark.parametrize("carriage", CARRIAGES)
@pytest.mark.parametrize(
    "fault",
    [
        LostFrames(at_s=0.05, for_s=0.2, rate=0.02, count=0),
        RepeatedFrames(at_s=0.05, for_s=0.2, rate=0.02, count=0),
        ReorderedFrames(at_s=0.05, for_s=0.2, rate=0.02, count=0, behind=2),
        ErrorFrames(at_s=0.05, for_s=0.2, rate=0.02, count=0),
    ],
    ids=lambda fault: fault.kind,
)
def test_what_a_fault_of_frames_destroyed_is_known_to_the_event(fault, carriage):
    b, report = play([fault], carriage=carriage)
    assert_known(b, report)
    if not isinstance(fault, ReorderedFrames):
        assert digest_of(b.events) == report.digest
    (did,) = report.faults
    assert did.hits > 0
    if isinstance(fault, LostFrames):
        assert did.events_lost > 0
        assert b.receiver.faults > 0
    if isinstance(fault, ErrorFrames):
        assert did.events_lost == 0
        assert b.receiver.counts["frames: error frame"] == did.hits


@pytest.mark.parametrize("carriage", CARRIAGES)
def test_what_never_arrives_is_counted_when_the_link_closes(carriage):
    b, report = play([LostFrames(at_s=0.05, for_s=10, rate=1, count=0)], carriage=carriage)
    assert_known(b, report)
    assert report.faults[0].events_lost > EVENTS // 2


@pytest.mark.parametrize("carriage", CARRIAGES)
def test_a_frame_that_is_held_comes_when_the_fault_is_over(carriage):
    b, report = play([ReorderedFrames(at_s=0.05, for_s=0.05, behind=1000)], carriage=carriage)
    assert_known(b, report)
    assert report.faults[0].hits == 1
    assert (report.faults[0].events_lost == 0) == (carriage == "raw")


@pytest.mark.parametrize("carriage", ["isotp", "cfp"])
def test_a_changed_frame_is_never_taken_where_messages_are_checked(carriage):
    b, report = play([ChangedFrames(at_s=0.05, rate=0.02, count=5)], carriage=carriage)
    assert_known(b, report)
    assert report.faults[0].events_lost > 0
    assert digest_of(b.events) == report.digest


def test_a_changed_raw_frame_is_taken_since_only_the_bus_would_check_it():
    _, report = play([ChangedFrames(at_s=0.05, rate=0.02, count=5)])
    assert report.camera.delivered == EVENTS
    assert report.faults[0].hits == 5
    assert 0 < report.faults[0].events_lost <= 10


def test_a_node_that_is_bus_off_comes_back():
    b, report = play([BusOff(at_s=0.1, for_s=0.3)], ticks=3000, heartbeat_ms=20)
    beats = np.array([t_ns - ORIGIN_NS for t_ns, _ in b.heard(b.p.identifiers.heartbeat)]) * 1e-9
    assert beats[0] < 0.1
    silent = np.flatnonzero(np.diff(beats) > 0.25)
    assert len(silent) == 1
    assert beats[silent[0]] == pytest.approx(0.1, abs=0.03)
    assert beats[silent[0] + 1] < 1.4  # it looks every second
    assert report.counts["bus lost"] == 1
    assert report.camera.not_running > 0
    assert report.delivered + report.dropped + report.dropped_in_device == EVENTS
    assert len(b.events) == report.delivered


async def test_when_bus_a_dies_the_camera_turns_to_bus_b(stamped_by):
    n = next(CHANNELS)
    b = Bench(
        [DeadBus(at_s=0.3, for_s=10.0)],
        channel=f"a-{n}",
        channel_b=f"b-{n}",
        redundancy=SelectorSettings(heartbeat_ms=200, toggle_ms=200),
        heartbeat_ms=10,
    )
    stamped_by(b.clock)

    def beats(bus):
        return b.heard(b.p.identifiers.heartbeat, bus)

    await b.start()
    master = to_message(Frame(b.p.identifiers.master_heartbeat, bytes([NodeState.OPERATIONAL])))
    while len(beats(1)) < 10:
        assert b.clock.now_ns() < b.origin_ns + 10**10
        for peer, slot in zip(b.peers, b.link.endpoint._slots, strict=True):
            peer.send(master)
            while not slot.bus._bus._unread:  # the reader of a bus is a thread, and its clock is the machine's
                await asyncio.sleep(0)
        b.clock.advance(10 * TICK_NS)
        await b.tick()
    await b.link.close()
    b.close()
    last_on_a, first_on_b = ((beats(bus)[at][0] - b.origin_ns) * 1e-9 for bus, at in ((0, -1), (1, 0)))
    assert 0.1 < last_on_a < 0.35
    assert first_on_b > 0.4  # after the master's heartbeat had been missing there for so long
    report = b.link.report(final=True)
    assert report.counts["bus changes"] == 1
    assert report.delivered + report.dropped + report.dropped_in_device == EVENTS


@pytest.mark.parametrize(("identifier", "most_frames"), [(0x100, 1), (0x000, None)])
def test_a_babbling_idiot_delays_our_sync_by_one_frame_unless_it_is_more_urgent(identifier, most_frames):
    clock = FakeClock(ORIGIN_NS)
    p = CanLink(sync_ms=10, heartbeat_ms=0, share=0.9)
    syncs = []
    ring = EventRing(1 << 14)
    plan = FaultPlan("can", (BabblingIdiot(at_s=0.0, for_s=0.5, identifier=identifier),), 1)
    factory = LinkFactory(CanEndpoint, p, Wiring(plan, lambda t_ns, seq: syncs.append(t_ns)))
    link = Link(LinkSetup("can", ring, partial(Instrument, (346, 260), p.instrument), factory), clock)
    # No server and no listener are needed to see the wire.
    bus = link.endpoint._slots[0].bus._bus
    assert isinstance(bus, ServedBus)
    type(bus).has_listeners, kept = property(lambda self: True), type(bus).has_listeners
    try:
        link.endpoint._slots[0].up = True
        ring.start(ORIGIN_NS)
        ring.publish(500_000)
        for _ in range(1000):
            clock.advance(TICK_NS)
            link.tick()
    finally:
        type(bus).has_listeners = kept
    if most_frames is None:
        assert len(syncs) < 10  # only before the flood begins
        return
    late_us = [(t_ns - ORIGIN_NS - TICK_NS) % 10_000_000 / 1000 for t_ns in syncs]
    assert len(syncs) >= 49
    assert max(late_us) < 2 * 135 + 60  # one frame of 135 us at most, then its own bits
    assert link.report().faults[0].touched > 3000
