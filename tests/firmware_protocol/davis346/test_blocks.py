"""Readings in the stream: whole blocks in time order with the events, their fates, and frames read back exactly."""

import dataclasses

import numpy as np
import pytest
from davis_host import RUN, Host, steady
from hypothesis import example, given
from hypothesis import strategies as st

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.davis346.registers import Layout
from firmware_protocol.device.fates import Counts
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.frames import FrameSettings, LineKind, line_record

FRAMES = ReadingKind.FRAMES
APS_RUN = (2, 4, 1)


def frame(layout, roi=(0, 0, 345, 259), start_us=1000, seed=0, line_us=10):
    """Lines of a frame of random values, (n,) of `line_record`, and the two reads in the user's frame."""
    left, top, right, bottom = roi
    reads = np.random.default_rng(seed).integers(0, 1024, (2, bottom - top + 1, right - left + 1), np.uint16)
    lines = reads if layout.turned else reads.swapaxes(1, 2)
    n = lines.shape[1]
    kinds = [LineKind.START, *[LineKind.RESET] * n, LineKind.EXPOSURE_START, LineKind.EXPOSURE_END]
    kinds += [*[LineKind.SIGNAL] * n, LineKind.END]
    told = np.zeros(len(kinds), line_record(346))
    told["t"], told["kind"] = start_us + line_us * np.arange(len(kinds)), kinds
    told["exposure"], told["global_shutter"], told["roi"] = 123_456_789, True, roi
    for read, kind in zip(lines, (LineKind.RESET, LineKind.SIGNAL), strict=True):
        told["samples"][told["kind"] == kind, : lines.shape[2]] = read
        told["length"][told["kind"] == kind] = lines.shape[2]
    return told, reads


def running(layout=Layout.UPRIGHT, **changes):
    camera = Davis346(Davis346Settings(start_delay_us=0, layout=layout, frames=True, **changes))
    host = Host(camera, layout.turned)
    host.write_all([*RUN, APS_RUN])
    return camera, host


def counted(camera):
    return camera.counters.readings["frames"]


@pytest.mark.parametrize("layout", list(Layout))
@pytest.mark.parametrize("roi", [(0, 0, 345, 259), (10, 20, 10, 20), (300, 3, 345, 259)])
@pytest.mark.parametrize("begin_us", [0, (1 << 31) - 3000, (1 << 32) - 3000])
def test_a_frame_among_events_is_read_back_exactly(layout, roi, begin_us):
    """Through 2^31 and 2^32 us too."""
    camera, host = running(layout, fifo_bytes=1 << 20)
    camera.advance(begin_us)
    lines, (reset, signal) = frame(layout, roi)
    lines["t"] += begin_us
    events = steady(3000, start_us=begin_us + 900)
    camera.offer_readings(FRAMES, lines)
    camera.offer(events)
    camera.advance(begin_us + 20_000)
    decoded = host.decoded()
    assert decoded.events.tolist() == events.tolist()
    (read,) = decoded.frames
    assert read.reset.tolist() == reset.tolist()
    assert read.signal.tolist() == signal.tolist()
    assert (read.roi, read.exposure_cycles, read.global_shutter) == (roi, 123_456_789, True)
    times = lines["t"][[0, -1]].tolist() + [int(lines["t"][lines["kind"] == k][0]) for k in (2, 3)]
    assert [read.start_us, read.end_us, read.exposure_start_us, read.exposure_end_us] == times
    assert host.decoder.faults.total == host.decoder._frames.incomplete == 0
    assert counted(camera) == Counts(offered=len(lines), delivered=len(lines))


@given(
    pieces=st.lists(st.integers(1, 400), min_size=1, max_size=40),
    reads=st.lists(st.integers(1, 900), min_size=1, max_size=20),
    every_us=st.integers(0, 40),
)
def test_however_the_stream_is_cut_blocks_stay_whole_and_in_order(pieces, reads, every_us):
    camera, host = running(fifo_bytes=1 << 20)
    lines, (reset, _) = frame(Layout.UPRIGHT, (5, 5, 24, 14), line_us=97)
    events = steady(600, start_us=1000)
    events["t"] = 1000 + every_us * np.arange(600)
    camera.offer_readings(FRAMES, lines)
    done, frames, got = 0, [], []
    while camera.now_us < 40_000:
        some = events[done : done + pieces[done % len(pieces)]]
        camera.offer(some) if len(some) else camera.advance(40_000)
        done += len(some)
        while transfer := camera.read(2, 2 * reads[done % len(reads)]):
            decoded = host.decoder.feed(transfer.data)
            camera.sent(transfer)
            frames += decoded.frames
            got += decoded.events.tolist()
    assert got == events.tolist()
    assert [one.reset.tolist() for one in frames] == [reset.tolist()]
    assert host.decoder.faults.total == 0
    assert counted(camera).accounted == counted(camera).delivered == len(lines)


def test_without_run_bits_readings_are_not_running():
    camera = Davis346(Davis346Settings(start_delay_us=0, frames=True))
    lines, _ = frame(Layout.UPRIGHT, (0, 0, 3, 3))
    assert camera.offer_readings(FRAMES, lines)
    host = Host(camera)
    host.write_all(RUN)
    assert camera.offer_readings(FRAMES, lines)
    camera.advance(10_000)
    assert host.decoded().frames == ()
    assert counted(camera) == Counts(offered=24, not_running=24)


def test_a_host_that_comes_in_the_middle_of_a_frame_gets_none_of_it():
    camera, host = running()
    first, _ = frame(Layout.UPRIGHT, (0, 0, 3, 3))
    second, _ = frame(Layout.UPRIGHT, (0, 0, 3, 3), start_us=5000)
    camera.offer_readings(FRAMES, first[3:])
    camera.offer_readings(FRAMES, second)
    camera.advance(10_000)
    assert len(host.decoded().frames) == 1
    assert host.decoder._frames.incomplete == 0
    assert counted(camera) == Counts(offered=21, not_running=9, delivered=12)


def test_lines_wait_for_room_where_the_register_says_so():
    lines, _ = frame(Layout.UPRIGHT, (0, 0, 99, 99))
    camera, host = running(fifo_bytes=4096)
    camera.offer_readings(FRAMES, lines)
    frames = []
    for now_us in range(0, 100_000, 1000):
        camera.advance(now_us)
        frames += host.decoded().frames
    assert len(frames) == 1
    assert frames[0].end_us > int(lines["t"][-1])
    assert counted(camera) == Counts(offered=len(lines), delivered=len(lines))


def test_lines_without_room_are_dropped_and_counted_where_they_may_not_wait():
    camera, host = running(fifo_bytes=4096)
    host.write(2, 5, 0)
    lines, _ = frame(Layout.UPRIGHT, (0, 0, 99, 99))
    camera.offer_readings(FRAMES, lines)
    camera.advance(10_000)
    assert host.decoded().frames == ()
    camera.advance(20_000)
    assert host.decoded().frames == ()
    assert host.decoder._frames.incomplete == 1  # its end came: start, exposure and end are never dropped
    assert counted(camera).dropped_fifo == len(lines) - counted(camera).delivered > 100


@pytest.mark.long
@pytest.mark.system
@example(words=[0, 0, 121], events=0)
@example(words=[400, 0, 0, 0, 0, 0, 0, 0], events=7)
@given(
    words=st.lists(st.integers(0, 170), min_size=3, max_size=20).filter(lambda words: 40 < np.mean(words) < 120),
    events=st.integers(0, 40),
)
def test_a_host_too_slow_for_all_frames_gets_fewer_and_those_whole(words, events):
    camera, host = running(fifo_bytes=2048)
    offered = [frame(Layout.UPRIGHT, (0, 0, 19, 19), 1000 + 1000 * k, seed=k) for k in range(60)]
    for lines, _ in offered:
        camera.offer_readings(FRAMES, lines)
    got = []
    for now_us in range(0, 90_000, 100):
        camera.offer(steady(events, now_us, seed=now_us))  # they take room, too
        camera.advance(now_us + 99)
        some = words[now_us // 100 % len(words)] if now_us < 70_000 else 10_000
        if some and (transfer := camera.read(2, 2 * some)) is not None:
            camera.sent(transfer)
            got += host.decoder.feed(transfer.data).frames
    sent = [reset.tolist() for _, (reset, _) in offered]
    places = [sent.index(one.reset.tolist()) for one in got]
    assert places == sorted(set(places))
    assert len(got) > 5
    assert host.decoder._frames.incomplete == host.decoder.faults.total == 0
    each, told = len(offered[0][0]), counted(camera)
    assert (told.dropped_fifo, told.delivered) == ((60 - len(got)) * each, len(got) * each)
    assert told.accounted == told.offered


def test_closing_the_gate_flushes_what_waits_and_what_is_queued():
    camera, host = running()
    lines, _ = frame(Layout.UPRIGHT, (0, 0, 3, 3))
    camera.offer_readings(FRAMES, lines)
    camera.advance(1050)
    host.write(0, 0, 0)
    assert counted(camera) == Counts(offered=12, flushed=12)


def test_a_lost_transfer_loses_its_readings():
    camera, _ = running()
    lines, _ = frame(Layout.UPRIGHT, (0, 0, 3, 3))
    camera.offer_readings(FRAMES, lines)
    camera.advance(10_000)
    transfer = camera.read(2, 8192)
    assert [one.kind for one in transfer.readings] == [FRAMES] * 12
    assert counted(camera).queued == 12
    camera.lost(transfer)
    assert counted(camera) == Counts(offered=12, lost_on_link=12)


def test_registers_tell_what_the_host_asks_of_frames():
    camera, host = running(Layout.TURNED)
    host.write_all([(2, 12, 30 * 500), (2, 13, 30 * 40_000), (2, 7, 0), (2, 8, 10), (2, 10, 400), (2, 11, 100)])
    asked = FrameSettings(*camera.reading_settings(FRAMES))
    expected = FrameSettings(True, False, False, 15_000, 500_000, 40_000_000, 10, 0, 345, 100)
    assert asked == expected
    host.write(2, 8, 346)
    assert not FrameSettings(*camera.reading_settings(FRAMES)).run
    host.write_all([(2, 8, 0), (0, 3, 0)])
    assert not FrameSettings(*camera.reading_settings(FRAMES)).run
    assert camera.reading_settings(ReadingKind.IMU) == ()
    assert dataclasses.replace(expected, run=True).roi == (10, 0, 345, 100)
