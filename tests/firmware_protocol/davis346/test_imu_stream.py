"""IMU samples in the camera's stream among events: as its registers say, each with one fate."""

import numpy as np
import pytest
from davis_host import RUN, Host, steady
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.davis346.registers import Layout
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.imu_samples import ImuSettings
from tests.made_events import samples_at

IMU = ReadingKind.IMU
MEASURE = [(3, 2, 1), (3, 3, 1), (3, 4, 1)]


def samples(n, start_us=1000, scale=0xE5, seed=0, period_us=999):
    counts = np.random.default_rng(seed).integers(-32768, 32768, (n, 7))
    return samples_at(start_us + period_us * np.arange(n), counts, scale)


def running(unit=2, measure=True, **changes):
    camera = Davis346(Davis346Settings(start_delay_us=0, imu_unit=unit, **changes))
    host = Host(camera, camera.settings.layout.turned)
    host.write_all([*RUN, *(MEASURE if measure else [])])
    return camera, host


def fates(camera):
    return camera.counters.readings["imu"]


@pytest.mark.parametrize("layout", list(Layout))
@pytest.mark.parametrize("begin_us", [0, (1 << 31) - 3000, (1 << 32) - 3000])
def test_samples_among_events_come_back_exactly(layout, begin_us):
    """Through 2^31 and 2^32 us too."""
    camera, host = running(layout=layout)
    camera.advance(begin_us)
    events, told = steady(5000, start_us=begin_us + 900), samples(5, begin_us + 1000)
    assert camera.offer_readings(IMU, told)
    camera.offer(events)
    camera.advance(begin_us + 20_000)
    decoded = host.decoded()
    assert decoded.events.tolist() == events.tolist()
    assert decoded.imu.tobytes() == told.tobytes()
    assert (fates(camera).offered, fates(camera).delivered) == (5, 5)
    assert host.decoder.faults.total == 0


@given(cuts=st.lists(st.integers(0, 40_000), max_size=6).map(sorted), scale=st.sampled_from([0xE5, 0x20, 0x4F, 0x83]))
def test_the_steps_do_not_matter(cuts, scale):
    camera, host = running()
    told = samples(30, scale=scale)
    there = [scale & 0x80] * 3 + [scale & 0x20] + [scale & 0x40] * 3
    told["counts"][:, [not one for one in there]] = 0
    for until in [*cuts, 40_000]:
        camera.offer_readings(IMU, told[(told["t"] <= until) & (told["t"] > camera.now_us)])
        camera.advance(until)
    assert host.decoded().imu.tobytes() == told.tobytes()


def test_without_a_unit_the_register_says_so_and_samples_have_no_use():
    camera, host = running(unit=0)
    assert host.read(3, 0) == 0
    assert not camera.offer_readings(IMU, samples(1))
    assert not ImuSettings(*camera.reading_settings(IMU)).run


@pytest.mark.parametrize("unit", [1, 2])
def test_the_unit_and_what_it_is_asked_show(unit):
    camera, host = running(unit=unit)
    assert host.read(3, 0) == unit
    host.write_all([(3, 5, 4), (3, 7, 3), (3, 10, 0)])
    asked = ImuSettings(*camera.reading_settings(IMU))
    assert (asked.run, asked.unit, asked.scale, asked.divider) == (1, unit, 0xEC, 5)
    host.write(0, 0, 0)
    assert not ImuSettings(*camera.reading_settings(IMU)).run


def test_while_it_does_not_run_samples_are_counted_as_not_running():
    camera, host = running(measure=False)
    camera.offer_readings(IMU, samples(4))
    camera.advance(20_000)
    assert len(host.decoded().imu) == 0
    assert (fates(camera).offered, fates(camera).not_running) == (4, 4)


def test_of_those_that_find_no_room_few_wait_and_the_rest_is_dropped():
    camera, host = running(fifo_bytes=1024)
    camera.offer_readings(IMU, samples(100, period_us=10))
    camera.advance(20_000)
    queued, dropped = fates(camera).queued, fates(camera).dropped_fifo
    assert dropped > 0
    assert queued + dropped == 100
    camera.advance(20_001)
    assert len(host.decoded().imu) > 0
    assert fates(camera).accounted == 100
