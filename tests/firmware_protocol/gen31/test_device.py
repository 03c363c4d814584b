"""A Gen 3.1 between its sensor and its host: identity, gate, window, noise filter, instruments, biases."""

import struct

import numpy as np
import pytest
from evk4_requests import DATA, Host, events_of
from gen31_host import GATE, START, STOP, opened, running
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.device.fates import Fates
from firmware_protocol.events import EdgeKind, make_edges
from firmware_protocol.evt.evt3 import Evt3Decoder
from firmware_protocol.gen31.device import BOARDS, Gen31, Gen31Settings
from firmware_protocol.usb.device import SetupPacket

# As neuromorphic_drivers' source has them (SilkyEvCam); of the EVK3 only the identity is compared by a driver.
AS_LISTED = {
    "silkyevcam_vga": ("31f7:0002", 0x00, "CenturyArks", "SilkyEvCam Gen3.1 v03.09.00C"),
    "evk3_vga": ("04b4:00f5", 0x28, "Prophesee", "EVK3"),
}


def received(camera, decoder=None):
    data = b""
    while (transfer := camera.read(DATA, 131_072)) is not None:
        camera.sent(transfer)
        data += transfer.data
    return (decoder or Evt3Decoder()).decode(data)


@pytest.mark.parametrize("name", BOARDS)
def test_a_driver_lists_it(name):
    usb_id, kind, *strings = AS_LISTED[name]
    camera = Gen31(Gen31Settings(serial="c0ffee", board=BOARDS[name]))
    host = Host(camera)
    assert f"{camera.identity.vendor_id:04x}:{camera.identity.product_id:04x}" == usb_id
    read = [camera.control(SetupPacket(0x80, 6, 0x0300 + k, 0x409, 255), b"") for k in (1, 2)]
    assert [text[2:].decode("utf-16-le") for text in read] == strings
    assert camera.control(SetupPacket(0xC0, 0x72, 0, 0, 2), b"") == bytes((kind, 0))
    assert host.ask("72000000 00000000") == "72000000 08000000 eeffc000 00000000"
    host.write((0x0218, 7), (0x0800, 7))
    assert host.register(0x0800) & 0xFF == 0x28  # OpenEB builds no other system
    assert host.register(0x0218) == 0x9020_0C02


def test_the_thermometer_is_a_second_device():
    host = Host(Gen31(Gen31Settings(celsius=21.4)))
    assert host.ask("00000100 00000000") == "00000100 04000000 02000000"
    texts = [bytes.fromhex(host.ask(f"{p:02x}000100 04000000 {n:02x}000000"))[12:] for p in (1, 3) for n in (0, 1)]
    assert texts == [b"CCam5 FPGA Event-Based Camera\0", b"Temperature Sensor\0", b"psee,ccam5_fpga\0", b"ti,tmp103\0"]
    read = struct.pack("<5I", 0x1_0102, 12, 1, 0, 1).hex()
    assert host.ask(read) == "02010100 0c000000 01000000 00000000 15000000"
    for property, device, address in ((0x1_0102, 1, 4), (0x4001_0102, 1, 0), (0x1_0102, 2, 0), (0x1_0001, 2, 0)):
        more = (address, 1) if property != 0x1_0001 else ()
        answer = host.ask(struct.pack(f"<{3 + len(more)}I", property, 4 + 4 * len(more), device, *more).hex())
        assert int.from_bytes(bytes.fromhex(answer)[:4], "little") == property | 0x8000_0000


@pytest.mark.parametrize(
    "missing", [(0x0000, 0x4_0000), (0x0000, 1), (0x0008, 0x200), (0x0008, 0x100), (0x0238, 1), (0x0204, 8)]
)
def test_nothing_leaves_before_the_whole_gate_is_open(missing):
    camera, host = running()
    address, bit = missing
    host.write(*STOP, *START[:-1])
    value = dict(GATE)[address]
    host.write(*STOP, *((at, value & ~bit if at == address else word) for at, word in START))
    camera.offer(events_of((10, 1, 1, True)))
    assert received(camera)[0].tolist() == []
    assert camera.counters == Fates(offered=1, not_running=1)
    host.write((address, value))
    assert camera.streaming


def test_the_octets_of_an_event():
    camera, host = running()
    camera.offer(events_of((7, 639, 479, True)))
    assert host.words() == [0x8000, 0x6007, 0x01DF, 0x2A7F]
    assert camera.counters == Fates(offered=1, delivered=1)


def test_the_noise_filter_holds_all_back_until_the_driver_turns_it_off():
    camera, host = opened()
    host.write(*GATE)
    camera.offer(events_of(*((t, 1, 1, True) for t in range(0, 1000, 3))))
    host.write((0x0248, 0xC8))
    camera.offer(events_of((2000, 2, 2, True)))
    assert received(camera)[0].tolist() == [(2000, 2, 2, True)]
    assert camera.counters == Fates(offered=335, not_selected=334, delivered=1)


def test_a_band_of_the_noise_filter_passes_the_period_after_one_with_enough_events():
    camera, host = running()
    host.write((0x024C, 100 << 14 | 3), (0x0248, 0xC9))
    offered = events_of(*((t, 1, 1, True) for t in (0, 50, 110, 120, 130, 210, 250, 310)))
    camera.offer(offered)  # 2 events in the first period, 3 in the second, 2 in the third
    assert received(camera)[0]["t"].tolist() == [210, 250]


@given(columns=st.sets(st.integers(0, 639), max_size=8), rows=st.sets(st.integers(0, 479), max_size=8))
def test_the_window_takes_over_with_each_write_of_bit_5(columns, rows):
    camera, host = running()
    words = [(0x0400 + 4 * k, sum(1 << x % 32 for x in columns if x // 32 == k)) for k in range(20)]
    words += [(0x0500 + 4 * k, sum(1 << y % 32 for y in rows if y // 32 == k)) for k in range(15)]
    host.write(*words)
    places = [(x, y) for x in sorted(columns) for y in sorted(rows)]
    places += [(0, 0), (639, 479), (320, 240)]
    offered = events_of(*((10 + k, x, y, True) for k, (x, y) in enumerate(places)))
    decoder = Evt3Decoder()
    camera.offer(offered)
    assert len(received(camera, decoder)[0]) == len(offered)
    host.write((0x0204, 0x2B), (0x0204, 0xB), *((address, 0) for address, _ in words), (0x0204, 0xB))
    camera.advance(1000)
    offered["t"] += np.uint64(1000)
    camera.offer(offered)
    inside = [event for event in offered.tolist() if event[1] in columns and event[2] in rows]
    assert received(camera, decoder)[0].tolist() == inside


def test_edges_come_while_the_trigger_input_is_on():
    edges = make_edges([50, 60], [EdgeKind.RISING, EdgeKind.FALLING])
    for value, seen in ((0, []), (1, [(50, 2, 0, 0), (60, 3, 0, 0)])):
        camera, host = running((0x01A0, value))
        camera.offer_edges(edges)
        camera.advance(100)
        assert received(camera)[1].tolist() == seen
        assert host.register(0x01A0) == value


@pytest.mark.parametrize("lux", [0.5, 100.0, 30_000.0])
def test_the_light_meter_by_openebs_formula(lux):
    _, host = opened(lux=lux)
    host.write((0x0214, 0), (0x0214, 1 << 31))
    assert not host.register(0x0214) & 1 << 29
    host.write((0x0214, 3 << 30))
    word = host.register(0x0214)
    assert word & 1 << 29
    t_us = (word & (1 << 27) - 1) / 100
    assert 10 ** (3.5 - np.log10(t_us * 0.37)) == pytest.approx(lux, rel=0.02)


def test_the_opening_leaves_the_biases_as_they_are():
    camera, _ = opened()
    assert (camera.sensor_factors, camera.without_effect) == ({}, {})
    assert camera.biases == {"diff_off": 30, "diff_on": 53, "diff": 41, "fo": 61, "pr": 847, "refr": 79, "hpf": 6}


@pytest.mark.parametrize(
    ("word", "factors"),
    [
        ((0x0350, 0x7900_003A), {"threshold_on": np.exp(5 * 0.051)}),  # five steps farther from diff
        ((0x034C, 0x7900_0019), {"threshold_off": np.exp(5 * 0.053)}),
        ((0x0354, 0x7900_002B), {"threshold_on": np.exp(-2 * 0.051), "threshold_off": np.exp(2 * 0.053)}),
        ((0x0358, 0x7100_2100), {"corner_max_hz": 1 - 28 / 61}),
        ((0x0360, 0x5100_9E00), {"refractory_us": 0.5}),
        ((0x0364, 0x5100_0800), {"highpass_hz": 2.0}),
    ],
)
def test_a_bias_moves_its_parameter(word, factors):
    camera, host = opened()
    host.write(word)
    assert camera.sensor_factors == pytest.approx(factors)


def test_a_bias_without_effect_is_named():
    camera, host = opened()
    host.write((0x035C, 0x5103_5000))
    assert camera.without_effect == {"pr": "it is not modelled"}


def test_a_band_set_while_the_filter_is_on_begins_anew():
    camera, host = running()
    host.write((0x024C, 100 << 14), (0x0248, 0xC9))
    camera.offer(events_of(*((t, 1, 1, True) for t in range(0, 300, 50))))
    host.write((0x024C, 100 << 14 | 1))
    camera.offer(events_of((310, 2, 2, True), (410, 3, 3, True)))
    assert received(camera)[0]["t"].tolist() == [100, 150, 200, 250, 410]


def test_the_next_driver_finds_nothing_of_the_one_before():
    camera, host = running((0x0400, 0), (0x0350, 0x7900_003A), (0x01A0, 1))
    host.write((0x0204, 0xB), (0x0204, 0x2B), (0x0000, 0))
    assert not camera.streaming  # the supply is off
    host.write((0x000C, 0), (0x000C, 1), *START)
    camera.offer(events_of((10, 0, 0, True)))
    assert received(camera)[0].tolist() == [(10, 0, 0, True)]
    assert (camera.sensor_factors, host.register(0x01A0), host.register(0x0400)) == ({}, 0, 0xFFFF_FFFF)


def test_power_on_forgets_all_that_a_host_wrote():
    camera, host = running((0x0400, 0), (0x0350, 0x7900_003A), (0x0248, 0xC9))
    host.write((0x0204, 0xB), (0x0204, 0x2B))
    camera.detached()
    host = Host(camera)
    assert not camera.streaming
    assert camera.sensor_factors == {}
    host.write(*START)
    camera.offer(events_of((10, 0, 0, True)))
    assert received(camera)[0].tolist() == [(10 - camera.epoch_us, 0, 0, True)]
