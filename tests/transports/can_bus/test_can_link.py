"""A link on a CAN bus: python-can's virtual bus in this process, with a receiver as its peer."""

import asyncio
import itertools
import time
from functools import partial

import can
import numpy as np
import pytest

from firmware_protocol.can_frames.canopen import Emergency, NmtCommand, NmtOrder, NodeState, scet
from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.transport import IsoTpSender
from firmware_protocol.events import EVENT, make_edges
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.packets.profile import Profile
from firmware_protocol.packets.telecommands import Ping
from firmware_protocol.receiver.can import CanReceiver
from tests.free_ports import free_port
from tests.made_events import scattered
from transports.can_bus.bus import BusDown, PythonCanBus, from_message, to_message
from transports.can_bus.endpoint import CanEndpoint
from transports.can_bus.kind import CanLink
from transports.link.endpoint import LinkFactory
from transports.link.kind import Wiring
from transports.link.pacing import FakeClock, MonotonicClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing

SIZE = (346, 260)
CHANNELS = itertools.count()
PATIENT = InstrumentSettings(queue_ms=60_000)
ANSWER_MS = 60_000  # ISO-TP gives up a message for which a busy machine does not answer within its second
PATIENCE_S = 120.0


def parameters(**more):
    usual = {"interface": "virtual", "channel": f"test-{next(CHANNELS)}", "share": 1.0, "answer_ms": ANSWER_MS}
    return CanLink(**usual | more)


def stream(n, gap_us=40, seed=1):
    return scattered(np.cumsum(np.random.default_rng(seed).exponential(gap_us, n)).astype(np.uint64), SIZE, seed)


class Peer:
    """A computer on the same virtual bus."""

    def __init__(self, p, channel=None):
        self.bus = can.Bus(interface="virtual", channel=channel or p.channel)
        self.receiver = CanReceiver(p.receiver)
        self.frames = []
        self.events, self.edges = [np.zeros(0, EVENT)], []

    def listen(self):
        while (message := self.bus.recv(0)) is not None:
            frame = from_message(message)
            self.frames.append(frame)
            self.receiver.push(frame, 0)
            self.events.append(self.receiver.take_events())
            self.edges.append(self.receiver.take_edges())
            for reply in self.receiver.take_replies():
                self.say(reply)

    def say(self, frame):
        self.bus.send(to_message(frame))

    def heard(self, identifier):
        return [frame.data for frame in self.frames if frame.identifier == identifier]


async def run(p, settings, events, work, *, sink=None, paced=False):
    """Run a link that is given `events` at once; `work(link, peer)` is called each tick until it says True."""
    ring = EventRing(1 << 16)
    device = partial(Instrument, SIZE, settings)
    link = Link(LinkSetup("can", ring, device, LinkFactory(CanEndpoint, p, Wiring(sink=sink))), MonotonicClock())
    peer = Peer(p)
    try:
        await link.endpoint.start()
        ring.start(MonotonicClock().now_ns() - 10**9 if paced else FREE_RUNNING)
        ring.push(events)
        ring.publish(int(events["t"][-1]) if len(events) else 0)
        end_s = time.monotonic() + PATIENCE_S
        while True:
            link.tick()
            peer.listen()
            if work(link, peer):
                break
            assert time.monotonic() < end_s, f"it never came to an end: {link.report()}"
            await asyncio.sleep(0.0002)
    finally:
        await link.close()
        peer.bus.shutdown()
    return link.report(final=True), peer


def until_delivered(link, peer):
    return link.idle


def go(p, events=None, work=until_delivered, settings=PATIENT, **more):
    events = np.zeros(0, EVENT) if events is None else events
    return asyncio.run(run(p, settings, events, work, **more))


@pytest.mark.parametrize(
    "more",
    [
        {"carriage": "raw"},
        {"carriage": "raw", "fd": True},
        {"carriage": "isotp"},
        {"carriage": "isotp", "fd": True},
        {"carriage": "cfp"},
    ],
)
def test_every_event_sent_is_received(more):
    p = parameters(**more)
    events = stream(3000)
    report, peer = go(p, events)
    got = np.concatenate(peer.events)
    order = ["t", "y", "x", "on"]
    assert np.array_equal(np.sort(got, order=order), np.sort(events, order=order))
    assert (report.delivered, report.dropped, report.camera.accounted) == (3000, 0, 3000)
    assert peer.receiver.faults == 0


@pytest.mark.parametrize("share", [0.2, 0.6, 0.9])
async def test_the_load_is_kept_at_the_share_within_two_percent(share):
    clock = FakeClock(10**9)
    ring = EventRing(1 << 16)
    link = Link(
        LinkSetup("can", ring, partial(Instrument, SIZE, PATIENT), LinkFactory(CanEndpoint, parameters(share=share))),
        clock,
    )
    ring.start(FREE_RUNNING)
    ring.push(stream(20_000))
    ring.publish(1_000_000)
    await link.endpoint.start()
    for _ in range(1000):
        link.tick()
        clock.advance(500_000)
    use = link.report().use
    await link.close()
    assert use.share == pytest.approx(share, rel=0.02)
    assert use.carried > 500


def test_nmt_orders_start_and_stop_the_camera():
    p = parameters(heartbeat_ms=5)
    orders = NmtOrder(NmtCommand.STOP, p.node), NmtOrder(NmtCommand.START, 99), NmtOrder(NmtCommand.START)
    awaited = [NodeState.OPERATIONAL, NodeState.STOPPED, NodeState.STOPPED, NodeState.OPERATIONAL]
    beats = []

    def work(link, peer):
        beats.extend(NodeState(beat[0]) for beat in peer.heard(p.identifiers.heartbeat))
        peer.frames.clear()
        if beats and beats[-1] is awaited[0]:
            awaited.pop(0)
            if not awaited:
                return True
            peer.say(Frame(p.identifiers.nmt, bytes(orders[-len(awaited)])))
        return False

    report, _ = go(p, None, work)
    assert beats[:2] == [NodeState.BOOT, NodeState.OPERATIONAL]
    assert report.counts["NMT orders"] == 2


def test_syncs_reach_the_sink_at_their_time_on_the_bus():
    p = parameters()
    marks = []
    counters = iter([1, 2, 4, 240, 1])

    def work(link, peer):
        counter = next(counters, None)
        if counter is not None:
            peer.say(Frame(p.identifiers.sync, bytes([counter])))
        return len(marks) == 5

    clock = MonotonicClock()
    before_ns = clock.now_ns()
    report, _ = go(p, None, work, sink=lambda t_ns, seq: marks.append((t_ns, seq)))
    assert [seq for _, seq in marks] == [1, 2, 4, 240, 1]
    assert all(before_ns <= t_ns <= clock.now_ns() for t_ns, _ in marks)
    assert report.counts["SYNC gaps"] == 2


def test_as_a_master_it_sends_sync_and_time():
    p = parameters(sync_ms=2, time_ms=2)
    marks = []
    _, peer = go(p, None, lambda *_: len(marks) >= 3, sink=lambda *mark: marks.append(mark))
    assert peer.heard(p.identifiers.sync)[:3] == [b"\x01", b"\x02", b"\x03"]
    assert [seq for _, seq in marks][:3] == [1, 2, 3]
    assert peer.heard(p.identifiers.scet)[0] == scet(0)


def test_an_overflow_is_told_by_an_emergency_and_its_end_too():
    p = parameters(share=0.05, bitrate=50_000)
    settings = InstrumentSettings(queue_events=2048, block_events=256)
    _, peer = go(p, stream(10_000), lambda _, peer: peer.heard(p.identifiers.emcy), settings, paced=True)
    assert Emergency.parse(peer.heard(p.identifiers.emcy)[0]).dropped > 1000


@pytest.mark.parametrize("carriage", ["raw", "isotp"])
def test_telecommands_by_isotp_are_obeyed_and_answered(carriage):
    p = parameters(carriage=carriage)
    computer = Profile("ccsds")
    sender = IsoTpSender(p.receiver.isotp)

    def work(link, peer):
        if not commands_sent:
            sender.start(computer.wrap_command(Ping()))
            commands_sent.append(1)
        for data in peer.heard(p.identifiers.telemetry):
            if data[0] >> 4 == 3:
                sender.flow_control(Frame(p.identifiers.telemetry, data), 0)
        frame = sender.next_frame(0)
        if frame is not None:
            peer.say(frame)
        return peer.receiver.counts.get("messages: verification") == 2

    commands_sent = []
    settings = InstrumentSettings(housekeeping_s=0)
    _, peer = go(p, None, work, settings)
    assert peer.receiver.counts["messages: pong"] == 1


def test_a_peer_that_never_answers_isotp_costs_messages_and_is_counted(monkeypatch):
    p = parameters(carriage="isotp", answer_ms=20)

    def deaf(link, _):
        return link.report().counts.get("ISO-TP messages given up", 0)

    monkeypatch.setattr(Peer, "say", lambda peer, frame: None)
    report, _ = go(p, stream(100), deaf, InstrumentSettings(housekeeping_s=0))
    assert report.dropped == 100
    assert report.camera.accounted == 100


def test_a_bus_that_goes_away_comes_back():
    p = parameters(heartbeat_ms=5)
    gone = []

    def work(link, peer):
        slot = link.endpoint._slots[0]
        if not gone and peer.frames:
            slot.bus._bus._bus.shutdown()  # as when an adapter is pulled out
            gone.append(slot.bus)
        if gone and not slot.up:
            slot.retry_ns = 0
            peer.frames.clear()
        return (
            gone and slot.up and len(peer.heard(p.identifiers.heartbeat)) > 2 and link.report().counts.get("bus lost")
        )

    report, _ = go(p, None, work)
    assert report.counts["bus lost"] == 1


def edges_of(count):
    return make_edges(1000 * np.arange(count), 4, seq=np.arange(count))


@pytest.mark.parametrize("carriage", ["raw", "isotp", "cfp"])
def test_edges_are_received_too(carriage):
    p = parameters(carriage=carriage)
    edges = edges_of(300)

    def work(link, peer):
        if not offered:
            link._device.offer_edges(edges)
            offered.append(1)
        return sum(map(len, peer.edges)) == 300

    offered = []
    _, peer = go(p, stream(10), work)
    assert np.array_equal(np.concatenate(peer.edges), edges)


def test_the_cameras_own_marks_have_frames_of_their_own():
    p = parameters()

    def work(link, peer):
        if not marked:
            marked.append(link.endpoint.mark(edges_of(3)))
        return len(peer.heard(p.identifiers.marks)) == 3

    marked = []
    _, peer = go(p, stream(10), work)
    assert marked == [3]
    assert np.array_equal(np.concatenate(peer.edges), edges_of(3))


@pytest.mark.parametrize("carriage", ["raw", "isotp", "cfp"])
def test_a_link_that_is_cut_short_leaves_no_event_without_a_fate(carriage):
    p = parameters(carriage=carriage, share=0.1)
    report, _ = go(p, stream(5000), lambda link, peer: link.report().use.carried > 50)
    assert report.camera.accounted == report.camera.offered
    assert report.camera.lost_on_link + report.camera.flushed > 0


@pytest.mark.socket
async def test_fd_frames_by_udp_multicast_come_once_and_to_the_others_only():
    pytest.importorskip("msgpack")
    p = parameters(interface="udp_multicast", channel="239.74.163.2", fd=True, options={"port": free_port()})
    one, two = PythonCanBus(p, p.channel), PythonCanBus(p, p.channel)
    try:
        await asyncio.gather(one.open(), two.open())
    except BusDown as reason:
        pytest.skip(f"no multicast here: {reason}")
    sent = [Frame(0x1A2, bytes([i]) * 64, fd=True, brs=True) for i in range(20)]
    heard, own = [], []
    for frame in sent:
        one.send(frame)
    end_s = time.monotonic() + PATIENCE_S
    while len(heard) < len(sent):
        assert time.monotonic() < end_s
        heard += [h.frame for h in two.take()]
        own += one.take()
        await asyncio.sleep(0.001)
    await asyncio.gather(one.close(), two.close())
    assert heard == sent
    assert own == []
