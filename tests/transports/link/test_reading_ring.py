"""Readings on their way to a link: bounded, counted, and the host's settings on their way back."""

import asyncio
from functools import partial

import numpy as np
import pytest

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.device.plain_device import PlainDevice
from firmware_protocol.frames import FrameSettings, LineKind, line_record
from transports.link.endpoint import LinkFactory
from transports.link.feed import ReadingReport
from transports.link.pacing import FakeClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing, ReadingRing
from transports.usb.kind import LoopbackLink
from transports.usb.loopback import LoopbackEndpoint

LOOPBACK = LinkFactory(LoopbackEndpoint, LoopbackLink())

RECORD = np.dtype([("t", "<u8"), ("value", "<i2", (3,))])


CAMERA = partial(Davis346, Davis346Settings(start_delay_us=0, frames=True))


def readings(times, record=RECORD):
    some = np.zeros(len(times), record)
    some["t"] = times
    return some


def test_what_finds_no_room_is_refused_and_counted():
    ring = ReadingRing(ReadingKind.IMU, RECORD, 4)
    assert ring.push(readings([1, 2, 3])) == 3
    assert ring.push(readings([4, 5])) == 1
    assert (ring.refused, ring.waiting, ring.room) == (1, 4, 0)
    assert [ring.time_of(k) for k in (0, 3, 4)] == [1, 4, None]
    assert ring.take(2)["t"].tolist() == [1, 2]
    assert ring.time_of(0) == 3


def frame_of(lines, start_us, most=8):
    told = np.zeros(2 * lines + 4, line_record(most))
    told["t"] = start_us + np.arange(len(told))
    told["kind"] = [LineKind.START, *[LineKind.RESET] * lines, 2, 3, *[LineKind.SIGNAL] * lines, LineKind.END]
    return told


def test_of_a_frame_all_finds_room_or_nothing():
    ring = ReadingRing(ReadingKind.FRAMES, line_record(8), 32)  # a frame has at most 20 records
    first, second, third = (frame_of(5, t_us) for t_us in (0, 100, 200))
    assert ring.push(first[:6]) == 6
    assert ring.push(np.concatenate([first[6:], second[:3]])) == 8
    assert ring.push(second[3:]) == 0
    assert (ring.refused, ring.waiting) == (len(second), len(first))
    assert not ring.fits(third)
    assert ring.take(13)["t"].tolist() == first["t"].tolist()
    assert ring.fits(third)
    assert ring.push(third) == len(third)
    assert ring.take(1000)["t"].tolist() == third["t"].tolist()


def test_a_ring_of_frames_holds_at_least_one():
    with pytest.raises(ValueError, match="at least one, 696 records"):
        ReadingRing(ReadingKind.FRAMES, line_record(346), 695)


def test_settings_come_back_whole():
    ring = ReadingRing(ReadingKind.IMU, RECORD, 4)
    assert ring.settings == ()
    ring.write_settings((1, 2, 3))
    assert ring.settings == (1, 2, 3)
    ring.write_settings((-5,))
    assert ring.settings == (-5,)
    ring.cells[0] += 1  # as in the middle of a writing
    ring.cells[2] = 9
    assert ring.settings == (-5,)


def linked(device, ring, endpoint=None, origin_ns=FREE_RUNNING):
    events, clock = EventRing(10_000), FakeClock(1_000_000_000)
    link = Link(LinkSetup("one", events, device, endpoint or LOOPBACK, readings=(ring,)), clock)
    asyncio.run(link.endpoint.start())
    events.start(origin_ns)
    return link, events, clock


def test_a_device_hears_of_readings_in_its_time_and_its_host_is_heard():
    ring = ReadingRing(ReadingKind.FRAMES, line_record(346), 1024)
    link, events, clock = linked(CAMERA, ring)
    ring.push(readings([100, 5000], line_record(346)))
    events.publish(1000)
    link.tick()
    report = link.report()
    assert not link.idle
    assert report.readings == {"frames": ReadingReport(taken=1)}
    assert report.readings_balanced
    events.publish(10_000)
    for _ in range(5):
        clock.advance(500_000)
        link.tick()
    assert link.idle
    assert FrameSettings.of(ring.settings).run
    assert FrameSettings.of(ring.settings).exposure_ns == 4_000_000
    asyncio.run(link.close())
    assert link.report(final=True).readings_balanced


def test_a_device_without_a_use_for_them_ignores_and_counts_them():
    ring = ReadingRing(ReadingKind.IMU, RECORD, 16)
    link, events, _ = linked(CAMERA, ring)
    ring.push(readings([1, 2, 3, 900]))
    events.publish(500)
    link.tick()
    report = link.report(final=True)
    assert report.readings == {"imu": ReadingReport(ignored=3, left=1)}
    assert report.readings_balanced
    assert not PlainDevice().offer_readings(ReadingKind.IMU, readings([1]))
    asyncio.run(link.close())
