"""What a link feeds its camera: edges in order with the events, held-back events, and the camera's own clock."""

import asyncio
from functools import partial

import numpy as np
import pytest

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.device.clock import ClockSettings, ClockStep
from firmware_protocol.events import EdgeKind
from tests.made_events import events_at
from tests.npz_records import load_edges
from transports.link.edges import EdgeRing, EdgeSink, EdgeTiming, PeriodicEdges
from transports.link.endpoint import LinkFactory
from transports.link.feed import EdgeReport, Feed, Timing
from transports.link.pacing import FakeClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing
from transports.recording.live import FileRecorder
from transports.recording.record import load_record
from transports.usb.kind import LoopbackLink
from transports.usb.loopback import LoopbackEndpoint

LOOPBACK = LinkFactory(LoopbackEndpoint, LoopbackLink())

ORIGIN_NS = 1_000_000_000
RISING = EdgeTiming(EdgeKind.RISING)


def stream(count, every_us):
    return events_at(np.arange(count) * every_us, x=np.arange(count) % 346, y=np.arange(count) % 260)


def linked(timing, path=None, origin_ns=ORIGIN_NS):
    """A running link to a host beside the camera, which checks all that it decodes."""
    ring, clock = EventRing(10_000), FakeClock(ORIGIN_NS)
    camera = partial(Davis346, Davis346Settings(start_delay_us=0))
    recorder = path and FileRecorder(path)
    link = Link(LinkSetup("loopback", ring, camera, LOOPBACK, recorder, timing=timing), clock)
    asyncio.run(link.endpoint.start())
    ring.start(origin_ns)
    return link, ring, clock


def close(link):
    asyncio.run(link.close())


def test_a_script_of_edges_is_delivered_at_its_times(tmp_path):
    link, ring, clock = linked(Timing(PeriodicEdges(1000, RISING)), tmp_path / "a.npz")
    ring.push(stream(100, every_us=100))
    ring.publish(10_000)
    for _ in range(24):
        link.tick()
        clock.advance(500_000)
    assert link.idle
    close(link)
    edges, resets = load_edges(tmp_path / "a.npz")
    assert resets == [0]
    assert edges[edges["kind"] == EdgeKind.RISING]["t"].tolist() == [1000 * k for k in range(1, 11)]
    report = link.report(final=True)
    assert report.edges == EdgeReport(taken=10)
    assert report.camera.edges.offered == 10


def heard(timing, holdback_us, delay_us):
    """A run with an edge at 5 ms that is heard `delay_us` after its time."""
    edges = EdgeRing()
    link, ring, clock = linked(Timing(edges, holdback_us))
    sink = EdgeSink([edges], ring, timing)
    ring.push(stream(100, every_us=100))
    ring.publish(20_000)
    for k in range(200):
        if k * 100 == 5000 + delay_us:
            sink(ORIGIN_NS + 5_000_000, 1)
        link.tick()
        clock.advance(100_000)
    return link


@pytest.mark.parametrize(("holdback_us", "delay_us", "late_us"), [(2000, 1900, 0), (2000, 3000, 900), (0, 200, 100)])
def test_events_held_back_let_an_edge_in_that_is_heard_late(holdback_us, delay_us, late_us):
    link = heard(RISING, holdback_us, delay_us)
    # The camera has seen time up to the tick before the edge is heard.
    assert link.report().edges == EdgeReport(taken=1, late=int(late_us > 0), worst_late_us=late_us)
    close(link)


def test_edges_still_to_come_at_the_end_are_told():
    edges = EdgeRing()
    link, ring, _ = linked(Timing(edges, 2000))
    EdgeSink([edges], ring, RISING)(ORIGIN_NS + 1000, 1)
    ring.publish(10_000)
    close(link)
    assert link.report(final=True).edges.left == 1


def test_a_free_run_takes_edges_with_the_events():
    link, ring, _ = linked(Timing(PeriodicEdges(1000, RISING)), origin_ns=FREE_RUNNING)
    ring.push(stream(1000, every_us=10))
    ring.publish(10_000)
    link.tick()
    close(link)
    assert link.report(final=True).edges == EdgeReport(taken=10)


def test_times_are_the_cameras_own(tmp_path):
    settings = ClockSettings(offset_us=500, drift_ppm=100, steps=(ClockStep(0.005, 2000),))
    timing = Timing(PeriodicEdges(1000, RISING), clock=settings, seed=1)
    link, ring, clock = linked(timing, tmp_path / "a.npz")
    events = stream(100, every_us=100)
    ring.push(events)
    ring.publish(10_000)
    for _ in range(30):
        link.tick()
        clock.advance(500_000)
    report = link.report()
    close(link)
    t = events["t"].astype(np.int64)
    expected = t + 500 + t * 100 // 1_000_000 + 2000 * (t >= 5000)
    got, _ = load_record(tmp_path / "a.npz")
    assert got["t"].tolist() == expected.tolist()
    edges, _ = load_edges(tmp_path / "a.npz")
    assert edges["t"][edges["kind"] == EdgeKind.RISING].tolist()[:5] == [1500, 2500, 3500, 4500, 7500]
    assert report.clock.offset_us == pytest.approx(2501, abs=0.5)
    assert report.clock.ppm == 100
    assert 0 <= report.latency.max <= 600  # in stream time: a clock that is wrong makes no link late


def test_a_clock_that_starts_anew_is_seen_as_a_reset(tmp_path):
    timing = Timing(clock=ClockSettings(drift_ppm=100, restarts_s=(0.00505,)))
    link, ring, clock = linked(timing, tmp_path / "a.npz")
    ring.push(stream(100, every_us=100))
    ring.publish(10_000)
    for _ in range(30):
        link.tick()
        clock.advance(500_000)
    report = link.report()
    close(link)
    got, resets = load_record(tmp_path / "a.npz")
    assert resets == [0, 51]
    assert got["t"].tolist() == [100 * k for k in range(51)] + [50 + 100 * k for k in range(49)]
    assert report.clock.offset_us == pytest.approx(1, abs=0.1)
    assert report.clock.epoch_us == 5050
    assert report.clock.device_us == pytest.approx(4951, abs=1)


def test_the_truth_of_the_clock_is_written_down(tmp_path):
    timing = Timing(clock=ClockSettings(offset_us=100, drift_ppm=50), truth=tmp_path / "truth.csv")
    link, ring, clock = linked(timing)
    ring.publish(10_000_000)
    for _ in range(3):
        clock.advance(2_000_000_000)
        link.tick()
        link.report()
    close(link)
    header, *lines = (tmp_path / "truth.csv").read_text().splitlines()
    assert header == "monotonic_ns,stream_us,device_us"
    seen = [(k * 2_000_000_000 + ORIGIN_NS, k * 2_000_000, k * 2_000_100 + 100) for k in (1, 2, 3, 3)]
    assert lines == [f"{monotonic_ns},{stream_us},{device_us}.000" for monotonic_ns, stream_us, device_us in seen]


def test_the_camera_says_when_its_own_time_comes_round():
    link, ring, clock = linked(Timing(send_period_us=1000, clock=ClockSettings(offset_us=300)))
    sent = []
    link.endpoint.mark = lambda edges: sent.extend(edges.tolist()) or len(edges)
    ring.publish(10_000)
    for _ in range(8):
        link.tick()
        clock.advance(500_000)
    close(link)
    assert link.report(final=True).edges == EdgeReport(marks=3, marks_sent=3)
    assert sent == [(1000, EdgeKind.PULSE, 0, 1), (2000, EdgeKind.PULSE, 0, 2), (3000, EdgeKind.PULSE, 0, 3)]


def test_edges_wait_for_the_events_of_a_cut_batch():
    offered = []
    ring, device = EventRing(1000), Davis346()
    device.offer_edges = lambda edges: offered.extend(edges["t"].tolist())
    feed = Feed(device, ring, Timing(PeriodicEdges(1000, RISING)))
    ring.push(stream(100, every_us=100))
    ring.publish(10_000)
    feed.feed(10_000, 35)
    assert offered == [1000, 2000, 3000]
    assert feed.reached_us == 3400
    feed.feed(10_000, 100)
    assert offered == [1000 * k for k in range(1, 11)]
