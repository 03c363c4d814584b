"""A camera that is fed as fast as its host reads, where events are far apart: single wraps, and no event dropped."""

import numpy as np
import pytest
from davis_host import RUN, Host, steady

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.device.clock import ClockSettings
from transports.link.feed import Feed, Timing
from transports.link.rings import FREE_RUNNING, EventRing

LIMIT = 1 << 17


class FreeLink:
    """What a link does in a run that is not paced, with a host that reads when it is told to."""

    def __init__(self, events, timing=None, **settings):
        self.camera = Davis346(Davis346Settings(**settings))
        self.host = Host(self.camera)
        self._ring = EventRing(1 << 12)
        self._ring.start(FREE_RUNNING)
        self._ring.push(events)
        self._ring.publish(int(events["t"][-1]))
        self._feed = Feed(self.camera, self._ring, timing or Timing())
        self.words = []

    def tick(self):
        room = self.camera.room_events if self.camera.streaming else LIMIT
        self._feed.feed(min(self._ring.now_us, self._feed.horizon_us), min(room, LIMIT))

    def read(self):
        while (transfer := self.camera.read(2, 512)) is not None:
            self.camera.sent(transfer)
            self.words.append(np.frombuffer(transfer.data, "<u2"))

    def time_without_steps_us(self):
        """Device time at the end for a reader that takes every wrap for one step, as neuromorphic_drivers does."""
        words = np.concatenate(self.words)
        return int(np.count_nonzero(words >> 12 == 7)) << 15


@pytest.mark.system
@pytest.mark.parametrize("gap_us", [3, 20_000, 33_000, 1_000_000, 300_000_000])
@pytest.mark.parametrize("fifo_bytes", [1024, 262_144])
def test_events_far_apart_come_all_and_with_single_wraps(gap_us, fifo_bytes):
    events = steady(2000 if gap_us < 10**6 else 60, start_us=5, step_us=gap_us)
    link = FreeLink(events, start_delay_us=0, fifo_bytes=fifo_bytes)
    link.host.write_all(RUN)
    for turn in range(100_000):
        link.tick()
        if turn % 7 == 0:
            link.read()
        if link.camera.counters.offered == len(events):
            break
    link.read()
    counters = link.camera.counters
    assert counters.dropped_fifo == counters.not_running == 0
    assert counters.delivered == len(events)
    assert link.time_without_steps_us() == int(events["t"][-1]) >> 15 << 15


def test_events_run_on_while_nobody_asks_for_them():
    events = steady(4000, start_us=0, step_us=40_000)
    link = FreeLink(events)
    link.tick()
    assert link.camera.counters.not_running == len(events)


def test_a_host_slow_to_start_gets_single_wraps_only():
    events = steady(2000, start_us=0, step_us=40_000_000)
    link = FreeLink(events, start_delay_us=0)
    clock, rest = RUN[:3], RUN[3:]
    link.host.write_all(clock)
    for _ in range(100):
        link.tick()
    link.host.write_all(rest)
    while link.camera.counters.offered < len(events):
        link.tick()
        link.read()
    assert link.camera.counters.not_running > 0
    assert link.time_without_steps_us() == int(events["t"][-1]) >> 15 << 15


def test_time_runs_on_once_a_host_has_stopped_the_words_alone():
    events = steady(4000, start_us=0, step_us=40_000_000)
    link = FreeLink(events, start_delay_us=0)
    link.host.write_all(RUN)
    link.tick()
    link.host.write_all([(9, 0, 0)])
    link.tick()
    assert link.camera.counters.offered == len(events)


@pytest.mark.parametrize("drift_ppm", [-1000, -50, 50, 333, 1000])
@pytest.mark.parametrize("start_delay_us", [1000, 99_999, 1_000_000])
def test_the_silence_of_a_start_ends_by_a_clock_of_any_rate(drift_ppm, start_delay_us):
    events = steady(500, start_us=5, step_us=4001)
    timing = Timing(clock=ClockSettings(drift_ppm=drift_ppm))
    link = FreeLink(events, timing, start_delay_us=start_delay_us)
    link.host.write_all(RUN)
    for _ in range(200):
        link.tick()
        link.read()
    counters = link.camera.counters
    assert counters.offered == len(events)
    assert counters.delivered == np.count_nonzero(events["t"] * (1 + drift_ppm * 1e-6) >= start_delay_us)
