"""The camera: gate, time, FIFO, requests with wrong data, and the fate of every event."""

import dataclasses

import numpy as np
import pytest
from davis_host import IN, OUT, RUN, Host, events_of, steady

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.davis346.words import WordEncoder
from firmware_protocol.device.fates import Fates
from firmware_protocol.usb.device import Stall

PROMPT = Davis346Settings(start_delay_us=0)


def running(**changes):
    """A camera that streams from time zero, and its host."""
    camera = Davis346(dataclasses.replace(PROMPT, **changes))
    host = Host(camera, camera.settings.layout.turned)
    host.write_all(RUN)
    return camera, host


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


# --- start delay and reset


def test_events_of_the_silence_are_not_running_and_the_rest_flows():
    camera, host = running(start_delay_us=1000)
    assert not camera.streaming
    camera.offer(steady(2000))
    assert camera.streaming
    assert host.decoded().events["t"].tolist() == list(range(1000, 2000))
    assert camera.counters == Fates(offered=2000, not_running=1000, delivered=1000)


def test_the_reset_word_leaves_during_the_silence_without_any_event():
    camera, host = running(start_delay_us=1_000_000)
    assert camera.read(2, 512) is None
    host.reset_timestamps()
    assert host.data() == b"\x01\x00"
    assert camera.streaming


def test_pixels_stopped_and_started_while_the_host_reads_are_not_silent():
    camera, host = running(start_delay_us=1000)
    camera.offer(steady(2000))
    assert len(host.decoded().events) == 1000
    host.write(1, 3, 0)
    host.write(1, 3, 1)
    assert camera.streaming
    camera.offer(steady(10, start_us=2000))
    assert len(host.decoded().events) == 10


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
    assert np.array_equal(host.decoded().events, steady(1000)[:kept])
    later = steady(50, start_us=2000)
    camera.offer(later)
    assert np.array_equal(host.decoded().events, later)
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


@pytest.mark.parametrize("max_bytes", [0, 1])
def test_a_read_without_room_for_a_word_gets_nothing(max_bytes):
    camera, _ = running()
    camera.offer(steady(1))
    assert camera.read(2, max_bytes) is None


# --- bad input


def test_events_that_go_back_in_time_are_refused_whole():
    camera, host = running()
    camera.advance(1000)
    for bad in (
        events_of((999, 1, 1, True)),
        events_of((40_000, 1, 1, True), (39_999, 1, 1, True)),
        events_of((1000, 346, 0, True)),
    ):
        with pytest.raises(ValueError, match=r"offered after|sorted|outside"):
            camera.offer(bad)
    assert camera.counters == Fates()
    assert host.data() == b""
    camera.offer(events_of((1000, 1, 1, True)))
    assert host.decoded().events.tolist() == [(1000, 1, 1, True)]


@pytest.mark.parametrize(
    ("kind", "request_code", "value", "index", "data", "length"),
    [
        (OUT, 0xBF, 0, 0, b"\0\0\0", 3),
        (OUT, 0xBF, 0, 0, b"\0\0\0\0\1", 5),
        (OUT, 0xBF, 0, 0, b"\0\0", 4),
        (OUT, 0xBF, 0, 0, b"", 0),
        (OUT, 0xC2, 2, 0, bytes(6), 6),
        (OUT, 0xC2, 1, 0, bytes(12), 12),
        (OUT, 0xC2, 2, 0, bytes((1, 4, 0, 0, 0, 1, 1, 5)), 12),
        (OUT, 0xB1, 4, 0, b"\0", 1),
        (OUT, 0xC6, 0, 0, b"\0", 1),
        (OUT, 0xB2, 0, 0, b"", 0),
        (OUT, 0xBE, 0, 0, bytes(64), 64),
        (OUT, 0xA0, 0, 0, bytes(64), 64),
        (IN, 0xBF, 6, 0, b"", 3),
        (IN, 0xB3, 0, 0, b"", 64),
        (IN, 0xC2, 1, 0, b"", 6),
        (0x41, 0xBF, 0, 0, bytes(4), 4),
        (0x20, 0xBF, 0, 0, bytes(4), 4),
        (0x60, 0xBF, 0, 0, bytes(4), 4),
    ],
)
def test_wrong_or_unknown_requests_stall_and_change_nothing(kind, request_code, value, index, data, length):
    camera, host = running()
    before = [host.read(m, p) for m in range(10) for p in range(145)]
    with pytest.raises(Stall):
        host.control(kind, request_code, value, index, data, length)
    assert [host.read(m, p) for m in range(10) for p in range(145)] == before
    assert camera.streaming


def test_a_register_reply_is_four_bytes_whatever_more_is_asked_for():
    _, host = running()
    assert host.control(IN, 0xBF, 6, 0, length=64) == b"\0\0\0\x12"


def test_endpoints():
    camera, host = running()
    assert camera.read(1, 64) is None
    for endpoint in (0, 3, 15):
        with pytest.raises(Stall):
            camera.read(endpoint, 64)
    camera.offer(steady(3))
    host.control(0x02, 3, 0, 0x82)
    with pytest.raises(Stall):
        camera.read(2, 64)
    host.clear_halt()
    assert len(camera.read(2, 64).events) == 3


@pytest.mark.parametrize(
    ("field", "value"),
    [("serial", ""), ("serial", "123456789"), ("serial", "é"), ("bcd_device", 0x10000), ("start_delay_us", -1)],
)
def test_bad_settings_are_refused(field, value):
    with pytest.raises(ValueError, match=field):
        Davis346Settings(**{field: value})


def test_a_fifo_too_small_or_an_array_too_large_is_refused():
    with pytest.raises(ValueError, match="1000 bytes"):
        Davis346(Davis346Settings(fifo_bytes=1000))
    with pytest.raises(ValueError, match="5000 x 10"):
        Davis346(Davis346Settings(size=(5000, 10)))
