"""The camera: gate, time, FIFO, requests with wrong data, and the fate of every event."""

import dataclasses

import numpy as np
import pytest
from davis_host import OUT, RUN, STOP, Host, events_of, steady

from firmware_protocol.davis346 import Davis346, Davis346Settings, Layout, WordEncoder
from firmware_protocol.device.fates import Fates

PROMPT = Davis346Settings(start_delay_us=0)


def running(**changes):
    """A camera that streams from time zero, and its host."""
    camera = Davis346(dataclasses.replace(PROMPT, **changes))
    host = Host(camera, camera.settings.layout.turned)
    host.write_all(RUN)
    return camera, host


def balanced(counters):
    """The sum of all fates is what was offered."""
    return counters.offered == counters.accounted


# --- run gate


@pytest.mark.parametrize("missing", RUN)
def test_nothing_flows_with_one_run_bit_missing(missing):
    camera = Davis346(PROMPT)
    host = Host(camera)
    host.write_all([entry for entry in RUN if entry != missing])
    camera.offer(steady(10))
    camera.advance(40_000)
    assert not camera.streaming
    assert camera.counters == Fates(offered=10, not_running=10)
    assert host.data() == (b"\x01\x70" if missing == (1, 3, 1) else b"")


@pytest.mark.parametrize("off", [(m, p, 0) for m, p, _ in RUN if (m, p) != (1, 3)])
def test_closing_the_gate_empties_the_fifo(off):
    camera, host = running()
    camera.offer(steady(10))
    host.write(*off)
    assert host.data() == b""
    assert camera.counters == Fates(offered=10, flushed=10)


def test_stopping_the_pixels_lets_queued_events_leave():
    camera, host = running()
    camera.offer(steady(10))
    host.write(1, 3, 0)
    assert len(host.decoded().events) == 10
    camera.offer(steady(5, start_us=100))
    assert camera.counters == Fates(offered=15, delivered=10, not_running=5)


def test_flush_request_empties_the_fifo_and_the_stream_stays_readable():
    camera, host = running()
    camera.offer(events_of((40_000, 1, 1, True), (40_000, 2, 2, True), (80_000, 3, 2, True)))
    got = host.decoder.feed(camera.read(2, 6).data).events
    host.control(OUT, 0xC6, 0, 0)
    camera.offer(events_of((80_000, 4, 2, False)))
    assert got["x"].tolist() == []
    assert host.decoded().events.tolist() == [(80_000, 4, 2, False)]
    assert camera.counters.flushed == 3
    assert host.decoder.faults.total == 0


def test_flush_keeps_a_reset_that_the_host_has_not_read():
    camera, host = running()
    camera.offer(steady(10, start_us=50_000))
    host.reset_timestamps()
    camera.offer(steady(10, start_us=70_000))
    host.control(OUT, 0xC6, 0, 0)
    camera.offer(events_of((70_100, 1, 1, True)))
    assert host.data() == np.array([1, 0x8000 | 70_100 - 50_009, 0x1001, 0x3001], "<u2").tobytes()


def test_detaching_and_attaching_return_to_power_on():
    camera, host = running()
    host.write(5, 11, 1234)
    camera.offer(steady(10))
    camera.detached()
    assert camera.counters == Fates(offered=10, flushed=10)
    host = Host(camera)
    assert not camera.streaming
    assert host.read(5, 11) == 24575
    assert host.read(0, 3) == 0


@pytest.mark.parametrize("cycle", range(3))
def test_time_starts_at_zero_with_each_run(cycle):
    camera = Davis346(PROMPT)
    for _ in range(cycle + 1):
        camera.advance(camera.now_us + 1_000_000)
        host = Host(camera)
        host.write_all(RUN)
        start_us = camera.now_us
        camera.offer(events_of((start_us + 7, 1, 2, True)))
        assert host.decoded().events.tolist() == [(7, 1, 2, True)]
        host.write_all(STOP)
        camera.detached()


# --- start delay and reset


def test_events_of_the_silence_are_not_running_and_the_rest_flows():
    camera, host = running(start_delay_us=1000)
    assert not camera.streaming
    camera.offer(steady(2000))
    assert camera.streaming
    events = host.decoded().events
    assert events["t"].tolist() == list(range(1000, 2000))
    assert camera.counters == Fates(offered=2000, not_running=1000, delivered=1000)


def test_the_reset_word_leaves_during_the_silence_without_any_event():
    camera, host = running(start_delay_us=1_000_000)
    assert camera.read(2, 512) is None
    host.reset_timestamps()
    assert host.data() == b"\x01\x00"
    assert camera.streaming


def test_what_is_queued_stays_silent_when_the_pixels_start_later():
    camera, host = running(start_delay_us=1000)
    host.write(1, 3, 0)
    camera.advance(32768)
    host.write(1, 3, 1)
    assert camera.read(2, 512) is None
    camera.advance(32768 + 1000)
    assert host.data() == b"\x01\x70"


def test_pixels_stopped_and_started_while_the_host_reads_are_not_silent():
    camera, host = running(start_delay_us=1000)
    camera.offer(steady(2000))
    assert len(host.decoded().events) == 1000
    host.write(1, 3, 0)
    host.write(1, 3, 1)
    assert camera.streaming
    camera.offer(steady(10, start_us=2000))
    assert len(host.decoded().events) == 10


def test_what_waits_when_the_pixels_are_stopped_and_started_leaves():
    camera, host = running(start_delay_us=1000)
    camera.offer(steady(2000))
    assert camera.read(2, 512) is not None
    host.write(1, 3, 0)
    host.write(1, 3, 1)
    assert camera.read(2, 512) is not None


def test_a_run_gate_that_is_opened_again_is_silent_again():
    camera, host = running(start_delay_us=1000)
    camera.offer(steady(2000))
    assert camera.read(2, 512) is not None
    host.write(0, 0, 0)
    host.write(0, 0, 1)
    assert not camera.streaming
    camera.offer(steady(500, start_us=2000))
    assert camera.counters.not_running == 1000 + 500


def test_wraps_owed_for_the_silence_come_when_it_ends():
    camera, host = running(start_delay_us=100_000)
    camera.advance(99_999)
    assert host.data() == b""
    camera.advance(100_000)
    assert host.data() == b"\x01\x70" * 3


def test_idle_wraps_flow_one_by_one():
    camera, host = running()
    for k in range(1, 11):
        camera.advance(k * 32768 - 1)
        assert camera.read(2, 512) is None
        camera.advance(k * 32768)
        assert host.data() == b"\x01\x70"


def test_a_transfer_never_spans_a_reset():
    camera, host = running()
    camera.offer(steady(3))
    camera.advance(1000)
    host.reset_timestamps()
    camera.offer(steady(3, start_us=2000))
    first, second = host.transfers()
    assert (first.epoch_us, second.epoch_us) == (0, 1000)
    assert len(first.events) == len(second.events) == 3
    assert second.data[:2] == b"\x01\x00"


def test_resets_of_a_stalled_host_do_not_pile_up():
    camera, host = running(fifo_bytes=1024)
    camera.offer(steady(1000))
    for _ in range(1000):
        host.reset_timestamps()
    data = host.data()
    assert len(data) <= 1024 + 2
    assert data[-2:] == b"\x01\x00"


# --- FIFO


def test_a_full_fifo_drops_whole_events_at_the_tail_and_counts_them():
    camera, host = running(fifo_bytes=1024)
    camera.offer(steady(1000))
    kept = camera.counters.queued
    assert camera.counters == Fates(offered=1000, dropped_fifo=1000 - kept, queued=kept)
    needed = WordEncoder().encode(steady(1000)).ends
    assert needed[kept - 1] <= 512 - 64 < needed[kept]
    events = host.decoded().events
    assert np.array_equal(events, steady(1000)[:kept])
    later = steady(50, start_us=2000)
    camera.offer(later)
    assert np.array_equal(host.decoded().events, later)
    assert host.decoder.faults.total == 0


@pytest.mark.parametrize("step_us", [0, 1, 500])
def test_what_was_dropped_is_not_taken_for_sent(step_us):
    """The next event has the time, the row and the wrap period of the last one dropped; the host knows none of them."""
    camera, host = running(fifo_bytes=1024)
    crowd = steady(1000, step_us=step_us)
    crowd["y"][400:] = 200
    camera.offer(crowd)
    kept = camera.counters.queued
    host.decoded()
    last = events_of((crowd["t"][-1], 1, 200, True))
    camera.offer(last)
    assert kept < 400 or step_us == 0
    assert np.array_equal(host.decoded().events, last)
    assert host.decoder.faults.total == 0


def test_drops_show_in_the_statistics_registers():
    camera, host = running(fifo_bytes=1024)
    camera.offer(steady(1000))
    kept = camera.counters.queued
    assert (host.read(0, 80), host.read(1, 80)) == (1, 1)
    assert (host.read(0, 83), host.read(0, 84)) == (0, 1000 - kept)
    assert (host.read(1, 85), host.read(1, 86)) == (0, 1000 - kept)
    assert (host.read(1, 83), host.read(1, 84)) == (0, kept)
    rows = int(np.count_nonzero(np.diff(steady(1000)["y"][:kept].astype(int)))) + 1
    assert (host.read(1, 81), host.read(1, 82)) == (0, rows)


def test_statistics_start_anew_with_power():
    camera, _ = running(fifo_bytes=1024)
    camera.offer(steady(1000))
    host = Host(camera)
    assert [host.read(1, k) for k in range(81, 93)] == [0] * 12
    assert camera.counters.dropped_fifo > 0


def test_room_is_kept_by_who_asks_first():
    camera, _ = running(fifo_bytes=4096)
    rng = np.random.default_rng(5)
    t_us = 0
    while camera.room_events:
        events = steady(camera.room_events, start_us=t_us, step_us=int(rng.integers(1, 300)))[:100]
        camera.offer(events)
        t_us = int(events["t"][-1]) + 1
    assert camera.counters.dropped_fifo == 0
    assert camera.counters.queued > 400


def test_a_long_stall_keeps_time_right_without_growing():
    camera, host = running(fifo_bytes=1024)
    camera.offer(steady(1000))
    for k in range(2000):
        camera.advance(40_000 + k * 32768)
    host.decoded()
    after = steady(10, start_us=camera.now_us + 5)
    camera.offer(after)
    assert np.array_equal(host.decoded().events, after)
    assert host.decoder.faults.total == 0


def test_wraps_of_a_short_stall_stay_single():
    camera, host = running(fifo_bytes=1024)
    camera.offer(steady(1000))
    for k in range(60):
        camera.advance(40_000 + k * 32768)
    words = np.frombuffer(host.data(), "<u2")
    wraps = words[words >> 12 == 7]
    assert wraps.tolist() == [0x7001] * 60


@pytest.mark.parametrize("max_bytes", [2, 3, 7, 64, 512, 8192, 131072])
def test_reads_of_any_size_give_the_same_stream(max_bytes):
    camera, host = running()
    events = steady(2000, step_us=30)
    camera.offer(events)
    transfers = host.transfers(max_bytes)
    assert all(len(t.data) <= max_bytes and len(t.data) % 2 == 0 for t in transfers)
    assert np.array_equal(np.concatenate([t.events for t in transfers]), events)
    assert np.array_equal(host.decoder.feed(b"".join(t.data for t in transfers)).events, events)


@pytest.mark.parametrize("max_bytes", [0, 1])
def test_a_read_without_room_for_a_word_gets_nothing(max_bytes):
    camera, _ = running()
    camera.offer(steady(1))
    assert camera.read(2, max_bytes) is None


def test_offered_events_are_copied():
    camera, host = running()
    events = steady(100)
    camera.offer(events)
    events["x"] = 0
    (transfer,) = host.transfers(8192)
    assert np.array_equal(transfer.events, steady(100))


def test_turned_layout_end_to_end():
    camera, host = running(layout=Layout.TURNED)
    assert [host.read(1, k) for k in range(3)] == [260, 346, 4]
    assert [host.read(2, k) for k in range(3)] == [260, 346, 4]
    events = steady(500)
    camera.offer(events)
    assert np.array_equal(host.decoded().events, events)


def test_other_sizes_stream_too():
    camera, host = running(size=(1280, 720))
    assert [host.read(1, k) for k in range(2)] == [1280, 720]
    events = events_of((1, 1279, 719, True))
    camera.offer(events)
    assert np.array_equal(host.decoded().events, events)
