"""A link fed from a ring: pacing, counting, recording, with a clock that the test moves."""

import asyncio
import multiprocessing
from functools import partial

import pytest

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.usb.device import Transfer
from tests.made_events import steady
from transports.link.deliveries import Deliveries, digest_of
from transports.link.endpoint import LinkBroken, LinkFactory
from transports.link.kind import Wiring
from transports.link.loop import LinkLoop, Stop, _is_read
from transports.link.pacing import FakeClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing
from transports.recording.live import FileRecorder
from transports.usb.kind import LoopbackLink
from transports.usb.loopback import LoopbackEndpoint

ORIGIN_NS = 1_000_000_000


def stream(count, every_us=10, start_us=0, seed=1):
    return steady(count, start_us, every_us, seed)


def loopback_link(tmp_path=None, ring=None, clock=None, start_delay_us=0):
    ring = ring or EventRing(10_000)
    record = FileRecorder(tmp_path / "link.npz") if tmp_path else None
    camera = partial(Davis346, Davis346Settings(start_delay_us=start_delay_us))
    setup = LinkSetup("loopback", ring, camera, LinkFactory(LoopbackEndpoint, LoopbackLink()), record)
    link = Link(setup, clock or FakeClock(ORIGIN_NS))
    asyncio.run(link.endpoint.start())
    return link, ring


def test_a_paced_link_holds_each_event_until_its_time():
    clock = FakeClock(ORIGIN_NS)
    link, ring = loopback_link(clock=clock)
    events = stream(100, every_us=100)
    ring.start(ORIGIN_NS)
    ring.push(events)
    ring.publish(10_000)
    delivered = []
    for _ in range(12):
        link.tick()
        delivered.append(link.report().delivered)
        clock.advance(1_000_000)
    assert delivered == [1, 11, 21, 31, 41, 51, 61, 71, 81, 91, 100, 100]


def test_a_link_never_runs_ahead_of_the_writer():
    clock = FakeClock(ORIGIN_NS)
    link, ring = loopback_link(clock=clock)
    ring.start(ORIGIN_NS)
    ring.push(stream(10, every_us=100))
    ring.publish(450)  # the writer is late: it has reached 0.45 ms
    clock.advance(5_000_000)
    link.tick()
    assert link.report().delivered == 5
    ring.publish(5000)
    link.tick()
    assert link.report().delivered == 10


def test_latency_is_from_the_events_own_time():
    clock = FakeClock(ORIGIN_NS)
    link, ring = loopback_link(clock=clock)
    ring.start(ORIGIN_NS)
    ring.push(stream(1, start_us=1000))
    ring.publish(5000)
    clock.advance(3_500_000)
    link.tick()
    latency = link.report().latency
    assert latency.max == 2500
    assert latency.p50 == 2500


def test_nothing_flows_before_the_run_starts():
    link, ring = loopback_link()
    ring.push(stream(10))
    ring.publish(1000)
    link.tick()
    assert link.report().delivered == 0
    assert ring.waiting == 10


def test_a_command_sent_before_the_start_of_a_run_precedes_its_events(monkeypatch):
    """The run may start while a tick reads the commands; its events are then fed by the next tick."""
    link, ring = loopback_link()

    def start():
        ring.start(ORIGIN_NS)
        ring.push(stream(1))

    monkeypatch.setattr(link.endpoint, "listen", start)
    link.tick()
    assert ring.waiting == 1


def test_a_free_link_takes_no_more_than_the_camera_has_room_for():
    ring = EventRing(200_000)
    link, _ = loopback_link(ring=ring)
    events = stream(150_000, every_us=1)
    ring.start(FREE_RUNNING)
    ring.push(events)
    ring.publish(150_000)
    while not link.idle:
        before = link.report().delivered
        link.tick()
        assert link.report().delivered > before
    report = link.report(final=True)
    assert (report.delivered, report.dropped, report.dropped_in_device) == (150_000, 0, 0)
    assert report.digest == digest_of(events)


def test_a_free_link_is_silent_after_the_start_as_long_as_its_host_needs():
    clock, ring = FakeClock(ORIGIN_NS), EventRing(10_000)
    link, _ = loopback_link(ring=ring, clock=clock, start_delay_us=300_000)
    for running in (0, 1):  # the host's reset of the timestamps has ended the first silence
        link.endpoint._camera.write_register(0, 0, running)
    ring.start(FREE_RUNNING)
    ring.push(stream(5000, every_us=1000))
    ring.publish(5_000_000)
    for _ in range(299):
        link.tick()
        clock.advance(1_000_000)
    assert link.report().delivered == 0
    clock.advance(2_000_000)
    while not link.idle:
        link.tick()
    assert link.report().delivered == 4700


def loopback(camera, ring):
    return LoopbackEndpoint(LoopbackLink(), Wiring(), camera, Deliveries(ring, FakeClock()))


class Liar(Davis346):
    """A camera that says it sent other events than it did."""

    def read(self, endpoint, max_bytes):
        transfer = super().read(endpoint, max_bytes)
        if transfer is None or not len(transfer.events):
            return transfer
        events = transfer.events.copy()
        events["x"][0] ^= 1
        return Transfer(events, epoch_us=transfer.epoch_us, data=transfer.data)


def test_the_loopback_host_compares_every_event():
    camera = Liar(Davis346Settings(start_delay_us=0))
    endpoint = loopback(camera, EventRing(16))
    asyncio.run(endpoint.start())
    camera.offer(stream(10))
    with pytest.raises(LinkBroken, match="others received"):
        endpoint.pump()


class Stalled:
    """A link that needs `turns` turns for what waits; the machine keeps each waiting for `turn_s`."""

    def __init__(self, clock, turns, turn_s):
        self.clock, self.left, self.turn_ns, self.ticks = clock, turns, int(turn_s * 1e9), 0
        self.changes, self.settled = (), 0
        self.ring = EventRing(1)
        self.endpoint = loopback(Davis346(), self.ring)
        self.next_ns = self.soonest_ns = self.ticked_ns = 0

    def asleep_us(self, until_ns):
        return 0

    def settle(self):
        self.settled += 1

    def tick(self):
        self.ticks += 1
        self.left -= 1
        self.clock.advance(self.turn_ns)

    @property
    def idle(self):
        return self.left <= 0

    def report(self):
        return None


@pytest.mark.parametrize(
    ("turns", "turn_s", "left"), [(20, 0.7, 0), (50, 0.0005, 0), (1000, 0.7, 1000 - 202), (5000, 0.0005, 5000 - 2002)]
)
async def test_the_drain_counts_the_links_own_time_and_has_an_end(turns, turn_s, left):
    clock = FakeClock(ORIGIN_NS)
    link = Stalled(clock, turns, turn_s)
    ours, theirs = multiprocessing.Pipe()
    ours.send(Stop(1.0))
    await LinkLoop(link, theirs, clock).run()
    assert link.left == left


def test_a_session_that_does_not_read_reports_is_noticed_before_the_pipe_blocks():
    ours, theirs = multiprocessing.Pipe()
    sent = 0
    while _is_read(ours):
        ours.send(bytes(1000))
        sent += 1
    assert sent > 5
    for _ in range(sent):
        theirs.recv()
    assert _is_read(ours)
    ours.close()
    theirs.close()
