"""The GenX320 between its sensor and its host: identity, opening, gate, forms of the words, instruments, biases."""

import math

import numpy as np
import pytest
from evt2_words import by_the_tables
from genx320_host import PROMPT, START, STOP, Host, events_of, octets, opened, running
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.device.fates import Fates
from firmware_protocol.events import EdgeKind, make_edges
from firmware_protocol.evt.evt3 import Evt3Decoder
from firmware_protocol.genx320.device import Genx320
from firmware_protocol.genx320.registers import Surroundings
from firmware_protocol.usb.device import SetupPacket
from tests.made_events import scattered

FORMS = {"evt2": 0, "evt3": 1, "evt21": 2}


def random_events(count, until_us=9_000_000, seed=5):
    return scattered(np.sort(np.random.default_rng(seed).integers(0, until_us, count)), (320, 320), seed)


def decoded(data, form):
    return Evt3Decoder().decode(data)[0] if form == "evt3" else by_the_tables(data, form)[0]


def test_identity():
    camera = Genx320(PROMPT)
    host = Host(camera)
    assert camera.control(SetupPacket(0x80, 6, 0x0100, 0, 18), b"")[8:12].hex() == "b404f500"
    configuration = camera.control(SetupPacket(0x80, 6, 0x0200, 0, 255), b"")
    assert configuration[9:18].hex() == "0904000003ff190000"
    assert [configuration[k] for k in (20, 33, 46)] == [0x82, 0x02, 0x81]  # as OpenEB requires them
    assert camera.control(SetupPacket(0xC0, 0x72, 0, 0, 2), b"") == b"\x3b\x00"
    assert host.ask("00000100 00000000") == "00000100 04000000 01000000"
    assert bytes.fromhex(host.ask("03000100 04000000 00000000"))[12:] == b"psee,cx3_genx320\0"
    assert host.ask("79000000 00000000") == "79000000 04000000 00090300"
    assert host.register(0x0014) == 0xB060_2003


def test_the_opening_leaves_the_gate_shut_by_time_alone():
    camera, host = opened()
    assert not camera.streaming
    assert (camera.sensor_factors, camera.without_effect) == ({}, {})
    assert host.register(0x7044) & 0x13 == 2  # EVT2.1, little-endian
    assert {camera.biases[name] for name in ("fo", "hpf", "diff_on", "diff", "diff_off", "refr")} == {
        34, 40, 25, 51, 28, 10,
    }  # fmt: skip
    host.write((0x9008, 0x195))
    assert camera.streaming


@pytest.mark.parametrize("missing", [0x0000, 0x9008, 0x9028])
def test_nothing_leaves_before_all_three_gates_are_open(missing):
    camera, host = opened()
    host.write((0x9028, 2), (0x0000, 0x802), *(entry for entry in START if entry[0] != missing))
    camera.offer(events_of((10, 1, 1, True)))
    assert octets(camera) == b""
    assert camera.counters == Fates(offered=1, not_running=1)


def test_the_octets_of_the_reference():
    camera, _ = running()
    camera.offer(events_of((1_000_000, 64, 100, True), (1_000_000, 67, 100, True)))
    assert octets(camera).hex() == "000000000000008000000000093d00800900000064000210"
    assert camera.counters == Fates(offered=2, delivered=2)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("max_bytes", [8, 13, 512, 131_072])
def test_every_event_comes_in_each_form_in_transfers_of_any_size(form, max_bytes):
    camera, _ = running((0x7044, FORMS[form]))
    events = random_events(3000)
    camera.offer(events)
    np.testing.assert_array_equal(decoded(octets(camera, max_bytes), form), events)
    assert camera.counters == Fates(offered=3000, delivered=3000)


@given(st.lists(st.sampled_from([*FORMS]), min_size=1, max_size=5), st.integers(0, 1 << 32))
def test_formats_stops_and_starts_amid_events_lose_none_that_was_read(forms, seed):
    camera, host = opened()
    for k, form in enumerate(forms):
        host.write((0x7044, FORMS[form]), *START)
        events = random_events(200, until_us=100_000, seed=seed)
        events["t"] += np.uint64(camera.now_us)
        epoch_us = camera.epoch_us
        camera.offer(events)
        seen = decoded(octets(camera), form)
        seen["t"] += np.uint64(epoch_us)
        np.testing.assert_array_equal(seen, events)
        host.write(*STOP)
        assert camera.counters == Fates(offered=200 * (k + 1), delivered=200 * (k + 1))


def test_another_format_amid_a_stream_drops_what_waits():
    camera, host = running()
    camera.offer(events_of((10, 1, 1, True)))
    host.write((0x7044, 1))
    camera.offer(events_of((20, 2, 2, True)))
    assert decoded(octets(camera), "evt3").tolist() == [(20, 2, 2, True)]
    assert camera.counters == Fates(offered=2, delivered=1, flushed=1)


def test_edges_come_from_power_on_until_the_host_switches_them_off():
    edges = make_edges([50, 60], [EdgeKind.RISING, EdgeKind.FALLING])
    camera, _ = running()
    camera.offer_edges(edges)
    camera.advance(100)
    seen = by_the_tables(octets(camera), "evt21")[1]
    assert [(t, kind) for t, kind, _, _ in seen.tolist()] == [(50, EdgeKind.RISING), (60, EdgeKind.FALLING)]
    for off in ((0x7040, 0xC1FF), (0x0608, 0x0421_4EA2 & ~(1 << 14))):
        camera, _ = running(off)
        camera.offer_edges(edges)
        assert camera.counters.edges.ignored == 2


def test_a_silence_carries_the_time_in_each_form():
    for form, value in FORMS.items():
        camera, _ = running((0x7044, value))
        camera.advance(30_000_000)
        camera.offer(events_of((30_000_005, 1, 2, True)))
        assert decoded(octets(camera), form).tolist() == [(30_000_005, 1, 2, True)]


def test_the_thermometer_the_light_meter_and_the_dead_time():
    _, host = opened(surroundings=Surroundings(celsius=21.6, lux=250.0, dead_time_us=120.0))
    host.write((0x004C, 0x0020_4E24))
    assert host.register(0x0050) & 1 << 11
    assert abs((host.register(0x0050) & 0x3FF) * 0.216 - 54 - 21.6) < 0.11
    host.write((0x0008, 3))
    count = host.register(0x0010)
    assert count >> 28 == 1
    assert math.exp(11.97 - 0.98 * math.log(count & 0x0FFF_FFFF)) == pytest.approx(250, rel=0.01)
    host.write((0x0010, count))
    assert host.register(0x0010) == 0
    host.write((0x0020, 3 << 30))
    assert host.register(0x0020) >> 28 == 0b1101
    assert (host.register(0x0020) & 0x0FFF_FFFF) // 50 == 120


def test_what_is_ready_is_reported():
    _, host = opened()
    assert host.register(0xC0C4) == 0
    host.write((0x00B8, 1), (0xD0C4, 4), (0xF008, 0x7020_0200), (0x6014, 4), (0x0034, 0b1011))
    assert host.register(0xC0C4) == 4
    assert host.register(0xD0C4) == 0
    host.write((0xD0C4, 1))
    assert host.register(0xD0C4) == 4
    assert (host.register(0xF008), host.register(0xF010)) == (0x0020_0200, 0xCAFE_BABE)
    assert host.register(0x6014) == 0x8000_0004
    assert host.register(0x0034) == 0x2_000B


def test_biases_are_absolute_and_act():
    camera, host = running()
    host.write(
        (0x1104, 0x1101_0000 | 35), (0x110C, 0x1101_0000 | 18), (0x1114, 0x1309_0000 | 30), (0x1004, 0x1301_0011)
    )
    assert camera.biases["diff_on"] == 35
    assert camera.sensor_factors == {
        "threshold_on": pytest.approx(math.exp(10 * 0.0286)),
        "threshold_off": pytest.approx(math.exp(-10 * 0.0416)),
        "refractory_us": pytest.approx(1 / 3),
        "corner_max_hz": pytest.approx(0.5),
    }
    host.write((0x0020, 3 << 30))
    assert (host.register(0x0020) & 0x0FFF_FFFF) / 50 == pytest.approx(100 / 3, abs=0.02)
    host.write((0x1100, 0x1301_0000), (0xD008, 1), (0xD000, 1))
    assert set(camera.without_effect) == {"hpf", "trail_filter"}
    host.write((0x001C, 1))
    assert (camera.sensor_factors, camera.without_effect, camera.streaming) == ({}, {}, False)


def test_events_outside_the_array_are_refused():
    camera, _ = running()
    for bad in (events_of((10, 320, 0, True)), events_of((10, 0, 320, True))):
        with pytest.raises(ValueError, match="320 x 320"):
            camera.offer(bad)
