"""The arrivals of a listener: counts, digest, jitter and record."""

from firmware_protocol.events import empty_edges
from tests.made_events import events_at
from transports.link.deliveries import LatencySummary, digest_of
from transports.link.pacing import FakeClock
from transports.reception import Arrivals
from transports.recording.record import Recorder, load_record


def test_arrivals_are_counted_timed_and_recorded(tmp_path):
    clock, recorder = FakeClock(5_000_000), Recorder(tmp_path / "got.npz")
    arrivals = Arrivals(clock, recorder)
    assert arrivals.jitter() == LatencySummary()
    arrivals.add(events_at([10, 20]), empty_edges(1), 1_020_000)
    arrivals.add(events_at([]), empty_edges(2), 1_100_000)
    arrivals.add(events_at([30]), empty_edges(), 1_034_000)
    clock.advance(250_000_000)
    recorder.close()
    assert (arrivals.events, arrivals.edges, arrivals.last_t_us, arrivals.seconds) == (3, 3, 30, 0.25)
    assert arrivals.digest == digest_of(events_at([10, 20, 30]))
    # 1000 us behind its own time, then 1004: 0 and 4 us later than the quickest
    assert (arrivals.jitter().p50, arrivals.jitter().max) == (2.0, 4.0)
    assert list(load_record(tmp_path / "got.npz")[0]["t"]) == [10, 20, 30]
