"""A link sleeps until something is due, and wakes for orders, requests and publications. Ticks are counted."""

import multiprocessing
import socket
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import pytest
from virtual_loop import VirtualLoop

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.device.plain_device import PlainDevice
from firmware_protocol.usb.usbip import ImportRequest
from tests.made_events import events_at
from transports.faults.script import FaultPlan
from transports.faults.usb import UsbUnplugged
from transports.link.edges import EdgeTrain, ListedEdges
from transports.link.endpoint import REST_NS, Endpoint, EndpointFactory, LinkFactory
from transports.link.feed import Timing
from transports.link.kind import Wiring
from transports.link.loop import Happen, InjectFault, LinkLoop, Stop
from transports.link.pacing import FakeClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing
from transports.usb.kind import LoopbackLink, UsbipLink
from transports.usb.loopback import LoopbackEndpoint
from transports.usb.usbip.endpoint import UsbipFactory

MS = 1_000_000
ORIGIN_NS = 1_000 * MS


class Recording(Davis346):
    """Camera that records the stream time of each start of power."""

    def __init__(self, settings=None):
        self.attached_us = []
        super().__init__(settings or Davis346Settings(start_delay_us=0))

    def attached(self):
        self.attached_us.append(self.now_us)
        super().attached()


@dataclass(frozen=True)
class Inbox(EndpointFactory):
    """Endpoint with one input: `early` reads it before the camera is fed, as a process that answers hosts has it."""

    connection: socket.socket
    early: bool = False
    hosted: bool = True
    got: list = field(default_factory=list)

    def build(self, device, deliveries):
        return InboxEndpoint(self, device, deliveries)


class InboxEndpoint(Endpoint):
    state = "open"
    longest_sleep_ns = REST_NS

    def __init__(self, factory, device, deliveries):
        self.at, self.device, self.deliveries = factory, device, deliveries

    async def start(self):
        self.at.connection.setblocking(False)
        self.device.run(self.at.hosted)

    @property
    def inputs(self):
        return (self.at.connection.fileno(),)

    def listen(self):
        if self.at.early:
            self.receive()

    def pump(self):
        self.receive()
        while (taken := self.device.take(1000)) is not None:
            self.deliveries.add(taken.events)
            self.device.sent(taken)

    def receive(self):
        try:
            self.at.got.append((self.at.connection.recv(100), self.device.now_us))
        except BlockingIOError:
            return

    async def close(self):
        self.at.connection.close()


class Bench:
    """A link in an event loop of virtual time, with the session's ends of its pipe and ring."""

    def __init__(self, endpoint, device=Recording, **more):
        self.clock = FakeClock(ORIGIN_NS)
        self.loop = VirtualLoop(self.clock)
        self.ring = EventRing(100_000)
        self.session, self.control = multiprocessing.Pipe()
        self.setup = LinkSetup("link", self.ring, device, endpoint, **more)
        self.ticks_ns = []

    @property
    def now_us(self):
        return (self.clock.now_ns() - ORIGIN_NS) // 1000

    def close(self):
        self.session.close()
        self.control.close()
        self.loop.close()

    def at(self, ms, function):
        self.loop.at(ORIGIN_NS + round(ms * MS), function)

    def run(self, seconds):
        """Run the link, and stop it after `seconds`; return it."""
        self.at(1000 * seconds, lambda: self.session.send(Stop(0.0)))
        return self.loop.run_until_complete(self._run())

    async def _run(self):
        self.link = Link(self.setup, self.clock)
        await self.link.endpoint.start()
        tick = self.link.tick
        self.link.tick = lambda: (self.ticks_ns.append(self.clock.now_ns()), tick())
        try:
            await LinkLoop(self.link, self.control, self.clock).run()
            return self.link.report()
        finally:
            await self.link.close()

    def publish_all(self, seconds):
        """Start a paced run whose session publishes a step of 10 ms each 10 ms, 20 ms ahead."""
        self.ring.start(ORIGIN_NS)
        for k in range(100 * seconds + 2):
            self.at(10 * (k - 2), partial(self.ring.publish, 10_000 * k))


@pytest.fixture
def new_bench(at_end):
    return lambda *args, **more: at_end.enter_context(closing(Bench(*args, **more)))


def test_a_link_without_a_host_wakes_each_four_milliseconds_and_for_reports(new_bench):
    bench = new_bench(UsbipFactory(UsbipLink(port=0)))
    bench.publish_all(1)
    bench.run(1)
    assert len(bench.ticks_ns) <= 250 + 10 + 3
    assert max(np.diff(bench.ticks_ns)) <= REST_NS


def test_single_events_leave_a_tenth_of_a_millisecond_after_their_time(new_bench):
    bench = new_bench(LinkFactory(LoopbackEndpoint, LoopbackLink()))
    bench.publish_all(1)
    bench.ring.push(events_at(range(10_300, 990_000, 10_000)))
    report = bench.run(1)
    assert report.delivered == 98
    assert 0 < report.latency.max <= 501  # half a millisecond after the last tick
    assert report.latency.p50 <= 110


def test_late_events_wake_a_sleeping_link(new_bench):
    bench = new_bench(LinkFactory(LoopbackEndpoint, LoopbackLink()))
    bench.ring.start(ORIGIN_NS)
    late_ms = [20 + 7.13 * k for k in range(100)]  # somewhere in each sleep of 1 ms
    for ms in late_ms:
        bench.at(ms, partial(bench.ring.push, events_at([int(1000 * ms)])))
        bench.at(ms, partial(bench.ring.publish, int(1000 * ms)))
    report = bench.run(1)
    assert report.delivered == 100
    assert report.latency.max <= 501  # half a millisecond after the last tick, and not the longest sleep
    assert report.latency.p50 <= 250


@pytest.mark.parametrize("step_us", [1000, 10_000])
def test_a_link_that_is_not_paced_follows_each_publication_at_once(new_bench, step_us):
    bench = new_bench(LinkFactory(LoopbackEndpoint, LoopbackLink()))
    bench.ring.start(FREE_RUNNING)
    behind = []

    def publish(k):
        behind.append((k - 1) * step_us - bench.ring.settled_us)
        bench.ring.push(events_at([k * step_us - 1]))
        bench.ring.publish(k * step_us)

    for k in range(1, 101):
        bench.at(0.01 * k, partial(publish, k))
    assert bench.run(0.1).delivered == 100
    assert max(behind) == 0
    assert len(bench.ticks_ns) <= 100 + 25 + 4


def test_an_order_acts_at_once_and_at_the_time_of_its_arrival(new_bench):
    bench = new_bench(UsbipFactory(UsbipLink(port=0)))
    bench.publish_all(1)
    acted = []

    def inject(fault, by=""):
        acted.append((bench.now_us, bench.link._device.now_us))
        Link.inject(bench.link, fault, by)

    def order():
        bench.link.inject = inject
        bench.session.send(InjectFault(UsbUnplugged(for_s=0.01)))

    bench.at(501.7, order)
    report = bench.run(1)
    assert acted == [(501_700, 501_700)]
    assert ORIGIN_NS + 501_700_000 in bench.ticks_ns  # and its effect is there
    assert report.faults[0].began_us == 501_700
    assert report.faults[0].ended_us - 511_700 <= 500


def test_an_edge_by_hand_has_the_time_of_its_order(new_bench):
    bench = new_bench(UsbipFactory(UsbipLink(port=0)))
    bench.publish_all(1)
    bench.at(301.9, lambda: bench.session.send(Happen(None, "user")))
    bench.run(1)
    assert bench.link._device.epoch_us == 301_900


@pytest.mark.parametrize("at_s", [0.5003, 0.75])
def test_a_scripted_fault_begins_within_a_millisecond(new_bench, at_s):
    plan = FaultPlan("usb", (UsbUnplugged(at_s=at_s, for_s=0.1),))
    bench = new_bench(UsbipFactory(UsbipLink(port=0), Wiring(plan)))
    bench.publish_all(1)
    report = bench.run(1)
    (fault,) = report.faults
    assert 0 <= fault.began_us - at_s * 1e6 <= 1000
    assert 0 <= fault.ended_us - (at_s + 0.1) * 1e6 <= 1000


def test_a_host_attaches_a_camera_that_has_been_fed_up_to_now(new_bench):
    bench = new_bench(UsbipFactory(UsbipLink(port=0)))
    bench.publish_all(1)
    host, server = socket.socketpair()

    def attach():
        host.sendall(bytes(ImportRequest("1-1")))

    async def serve():
        await bench.link.endpoint._server.serve(server)

    bench.at(100, lambda: bench.loop.create_task(serve()))
    bench.at(777.7, attach)
    bench.run(1)
    host.close()
    assert bench.link._device.attached_us == [777_700]


@pytest.mark.parametrize("early", [False, True])
def test_a_request_at_an_input_is_answered_by_a_camera_that_has_been_fed_up_to_now(new_bench, early):
    ours, theirs = socket.socketpair()
    endpoint = Inbox(theirs, early, hosted=False)
    bench = new_bench(endpoint, PlainDevice)
    bench.publish_all(1)
    bench.at(333.3, partial(ours.sendall, b"?"))
    bench.run(1)
    ours.close()
    assert endpoint.got == [(b"?", 333_300)]


def test_an_input_that_is_readable_all_the_time_does_not_keep_a_link_awake(new_bench):
    ours, theirs = socket.socketpair()
    ours.close()  # the end of the stream can be read for ever
    bench = new_bench(Inbox(theirs), PlainDevice)
    bench.publish_all(1)
    bench.run(1)
    assert len(bench.ticks_ns) <= 2000 + 10 + 3


def test_edges_of_a_list_are_applied_at_their_time(new_bench):
    timing = Timing(edges=ListedEdges([EdgeTrain(1, 10_400, 50_000, 10)]))
    bench = new_bench(LinkFactory(LoopbackEndpoint, LoopbackLink()), timing=timing)
    bench.publish_all(1)
    report = bench.run(1)
    assert report.edges.taken == 10
    assert report.edges.worst_late_us == 0
    assert {10_500 + 50_000 * k for k in range(10)} <= {(t_ns - ORIGIN_NS) // 1000 for t_ns in bench.ticks_ns}


def test_the_end_of_the_session_ends_a_link_that_sleeps(new_bench):
    bench = new_bench(UsbipFactory(UsbipLink(port=0)))
    bench.publish_all(1)
    bench.at(100, bench.session.close)
    with pytest.raises((EOFError, ConnectionError)):
        bench.run(1)
    assert bench.now_us <= 100_000
