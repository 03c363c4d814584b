"""The camera between its sensor and its host: gate, time, words, fates."""

import dataclasses
import math

import numpy as np
import pytest
from evk4_requests import DATA, START, STOP, Host, events_of

from firmware_protocol.device.fates import Fates
from firmware_protocol.events import EdgeKind, make_edges
from firmware_protocol.imx636.evk4 import Evk4, Evk4Settings
from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import SetupPacket, Stall

PROMPT = Evk4Settings(start_delay_us=0)


def running(**changes):
    camera = Evk4(dataclasses.replace(PROMPT, **changes))
    host = Host(camera)
    host.write(*START)
    return camera, host


def test_the_words_of_some_events():
    camera, host = running()
    camera.offer(events_of((4100, 7, 5, True), (4100, 1279, 5, False), (4101, 0, 719, True)))
    high_0, high_1, low_4, low_5 = 0x8000, 0x8001, 0x6004, 0x6005
    assert host.words() == [high_0, high_1, low_4, 0x0005, 0x2807, 0x24FF, low_5, 0x02CF, 0x2800]
    assert camera.counters == Fates(offered=3, delivered=3)


def test_nothing_leaves_before_all_three_gates_are_open():
    for missing in (0x9028, 0x9008, 0x0004):
        camera = Evk4(PROMPT)
        host = Host(camera)
        host.write((0x9028, 2), *(entry for entry in START if entry[0] != missing))
        camera.offer(events_of((10, 1, 1, True)))
        assert host.words() == []
        assert not camera.streaming
        assert camera.counters == Fates(offered=1, not_running=1)


def test_device_time_is_zero_when_time_starts_to_run():
    camera = Evk4(PROMPT)
    host = Host(camera)
    camera.advance(1_000_000)
    host.write(*START[:3])
    camera.advance(1_000_003)
    host.write(*START[3:])
    camera.offer(events_of((1_000_005, 1, 2, False)))
    assert host.words() == [0x8000, 0x6005, 0x0002, 0x2001]
    assert camera.epoch_us == 1_000_000


def test_a_silence_follows_the_start():
    camera, host = running(start_delay_us=300)
    assert (camera.silent_until_us, camera.horizon_us) == (300, 300)
    camera.offer(events_of((299, 1, 1, True), (300, 2, 2, True)))
    assert host.words() == [0x8000, 0x612C, 0x0002, 0x2802]
    assert camera.counters == Fates(offered=2, not_running=1, delivered=1)


def test_a_silence_of_the_scene_is_told():
    camera, host = running()
    camera.advance(4095)
    assert host.words() == []
    camera.advance(8192)
    assert host.words() == [0x8000, 0x8002]
    camera.advance(30_000_000)
    told = host.words()
    highs = np.array(told) & 0xFFF
    steps = np.diff(np.concatenate([[2], highs])) % 4096
    assert all(word >> 12 == 8 for word in told)
    assert steps.max() < 2048
    assert int(steps.sum()) == 30_000_000 // 4096 - 2


def test_a_stop_drops_what_waits_and_a_start_begins_anew():
    camera, host = running()
    camera.offer(events_of((10, 1, 1, True), (20, 2, 2, True)))
    host.write(*STOP)
    assert camera.counters == Fates(offered=2, flushed=2)
    camera.advance(1000)
    host.write(*START)
    camera.offer(events_of((1001, 3, 3, True)))
    assert host.words() == [0x8000, 0x6001, 0x0003, 0x2803]


def test_writing_the_masks_again_does_not_interrupt_the_stream():
    camera, host = running(start_delay_us=100)
    camera.advance(200)
    host.write((0x0004, 0xF000_5462))
    camera.offer(events_of((201, 1, 1, True)))
    assert camera.streaming
    assert len(host.words()) == 4


def test_the_buffer_is_bounded():
    camera, host = running(fifo_bytes=6 * 400)
    events = np.zeros(1000, events_of((0, 0, 0, False)).dtype)
    events["t"] = np.arange(1000)
    camera.offer(events)
    assert camera.room_events == 0
    assert camera.counters == Fates(offered=1000, dropped_fifo=600, queued=400)
    host.words()
    assert camera.room_events == 400
    assert camera.counters == Fates(offered=1000, dropped_fifo=600, delivered=400)


def test_the_trigger_input_is_told_when_it_is_on():
    camera, host = running()
    edges = make_edges([50, 60], [EdgeKind.RISING, EdgeKind.FALLING])
    camera.offer_edges(edges)
    host.write((0x7004, 0xC5FF))
    camera.offer_edges(edges)
    camera.offer(events_of((60, 9, 9, True)))
    assert host.words() == [0x8000, 0x6032, 0xA001, 0x603C, 0xA000, 0x0009, 0x2809]
    assert camera.counters.edges.accounted == 4
    assert (camera.counters.edges.ignored, camera.counters.edges.delivered) == (2, 2)


def test_a_transfer_that_is_lost_is_counted():
    camera, _ = running()
    camera.offer(events_of((10, 1, 1, True)))
    transfer = camera.read(DATA, 4096)
    assert camera.counters == Fates(offered=1, queued=1)
    camera.lost(transfer)
    camera.detached()
    assert camera.counters == Fates(offered=1, lost_on_link=1)


def test_biases_act_until_power_on_and_those_that_do_not_are_told():
    camera, host = running()
    assert (camera.sensor_factors, camera.without_effect) == ({}, {})
    host.write((0x1018, 0x11A1_0049 + 50), (0x100C, 0x11A1_0020))
    assert camera.sensor_factors == {"threshold_off": pytest.approx(math.exp(50 * 0.0136)), "highpass_hz": 32.0}
    host.write((0x1014, 0x11A1_004E))
    assert list(camera.without_effect) == ["diff"]
    camera.attached()
    assert (camera.sensor_factors, camera.without_effect) == ({}, {})


def test_bad_events_are_refused_whole():
    camera, host = running()
    camera.advance(1000)
    for bad in (
        events_of((999, 1, 1, True)),
        events_of((2000, 1, 1, True), (1999, 1, 1, True)),
        events_of((1000, 1280, 0, True)),
        events_of((1000, 0, 720, True)),
    ):
        with pytest.raises(ValueError, match="events"):
            camera.offer(bad)
    assert camera.counters == Fates()
    assert host.words() == []


def test_endpoints_need_a_configuration():
    camera = Evk4(PROMPT)
    camera.attached()
    for use in (lambda: camera.read(1, 512), lambda: camera.read(2, 512), lambda: camera.write(2, bytes(8))):
        with pytest.raises(Stall):
            use()
    camera.control(SetupPacket(0x00, 9, 1, 0, 0), b"")
    assert camera.read(1, 512) is None
    for use in (lambda: camera.write(1, bytes(8)), lambda: camera.write(3, bytes(8)), lambda: camera.read(3, 512)):
        with pytest.raises(Stall):
            use()


@pytest.mark.parametrize("bad", [{"serial": "xyz"}, {"serial": ""}, {"serial": "123456789"}, {"fifo_bytes": 10}])
def test_settings_that_no_camera_can_have_are_refused(bad):
    with pytest.raises(ValueError, match=r"serial|fifo_bytes"):
        Evk4Settings(**bad)


def test_at_high_speed_packets_are_smaller():
    camera = Evk4(Evk4Settings(speed=Speed.HIGH))
    configuration = camera.control(SetupPacket(0x80, 6, 0x0200, 0, 255), b"")
    assert [int.from_bytes(configuration[k : k + 2], "little") for k in (22, 29, 36)] == [512, 512, 512]
