"""A DVXplorer: identity, gate, filters, biases, read-out registers, samples, edges, and requests with wrong data."""

import dataclasses
from contextlib import suppress

import numpy as np
import pytest
from davis_host import events_of
from dvxplorer_host import MEASURE, RUN, Host, running, scans, scattered
from dvxplorer_reader import read
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.device.fates import Fates
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.dvxplorer.device import Dvxplorer, DvxplorerSettings
from firmware_protocol.events import make_edges
from firmware_protocol.imu_samples import ImuSettings, no_samples, physical
from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import Stall
from tests.made_events import samples_at

IMU = ReadingKind.IMU


def sent_by(host):
    """What a slow reader finds in all that the camera has."""
    reader = read(host.data())
    assert reader.wrong == []
    return reader


# --- identity and gate


def test_the_drivers_find_what_they_check():
    camera = Dvxplorer(DvxplorerSettings(serial="00000042", imu_unit=3))
    identity = camera.identity
    assert (identity.vendor_id, identity.product_id, identity.bcd_device) == (0x152A, 0x8419, 0x0309)
    host = Host(camera)
    assert [host.read(6, k) for k in (0, 1, 2, 3, 5, 6, 7)] == [18, 20, 1, 104, 80, 1000, 4]
    assert [host.read(1, k) for k in range(3)] == [640, 480, 3]
    assert (host.read(3, 0), host.read(4, 10)) == (3, 1)
    for speed, packet in ((Speed.SUPER, 1024), (Speed.HIGH, 512)):
        interface = dataclasses.replace(camera.settings, speed=speed).descriptors().configuration.interfaces[0]
        assert [(one.address, one.max_packet) for one in interface.endpoints] == [(0x81, 64), (0x82, packet)]


@pytest.mark.parametrize("missing", RUN)
def test_nothing_flows_with_one_run_bit_missing(missing):
    camera = Dvxplorer(DvxplorerSettings(start_delay_us=0))
    host = Host(camera)
    host.write_all([entry for entry in RUN if entry != missing])
    camera.offer(scattered(10))
    camera.advance(40_000)
    assert not camera.streaming
    assert camera.counters == Fates(offered=10, not_running=10)
    assert host.data() == (b"\x01\x70" if missing[0] in (1, 5) else b"")  # the clock runs without the DVS


def test_every_event_of_scans_arrives_in_transfers_of_any_length():
    camera, host = running()
    events = scans(20_000)
    camera.offer(events)
    seen = []
    for size in [2, 6, 10, 512, *[4096] * 100]:
        transfer = camera.read(2, size)
        if transfer is None:
            break
        assert 0 < len(transfer.data) <= size
        camera.sent(transfer)
        seen += host.decoder.feed(transfer.data).events.tolist()
        assert seen == events.tolist()[: camera.counters.delivered]
    assert seen == events.tolist()
    assert camera.counters == Fates(offered=len(events), delivered=len(events))


def test_the_host_chooses_the_grammar():
    events = scans(2000)
    lengths = []
    for packet_format in (0x80, 0x00):
        camera, host = running([(5, 0x3067, packet_format)])
        camera.offer(events)
        data = host.data()
        lengths.append(len(data))
        assert (2 in {word >> 12 for word in np.frombuffer(data, "<u2").tolist()}) == (packet_format == 0x80)
        assert read(data).events == events.tolist()
    assert lengths[0] < lengths[1]


def test_a_reset_comes_before_later_events_and_ends_the_silence():
    camera = Dvxplorer(DvxplorerSettings(start_delay_us=300_000))
    host = Host(camera)
    host.write_all(RUN)
    camera.advance(5000)
    assert host.data() == b""
    host.reset_timestamps()
    camera.offer(events_of((5007, 9, 10, True)))
    reader = sent_by(host)
    assert (reader.resets, reader.events) == (1, [(7, 9, 10, True)])
    assert camera.take_resets() == (5000,)


def test_a_full_buffer_drops_the_newest_events_whole_and_counts_columns_and_groups():
    camera, host = running(fifo_bytes=1024)
    events = scans(4000)
    camera.offer(events)
    fates = camera.counters
    assert fates.queued > 100
    assert fates.dropped_fifo == len(events) - fates.queued
    columns, groups, lost_columns, lost_groups = (host.read(1, k + 1) for k in (81, 83, 85, 87))
    reader = sent_by(host)
    assert reader.events == events.tolist()[: fates.queued]
    assert columns == len({(t, x) for t, x, _, _ in reader.events})
    assert min(groups, lost_columns, lost_groups) > 0
    assert host.read(0, 84) == fates.dropped_fifo
    assert columns + lost_columns == len({(t, x) for t, x, _, _ in events.tolist()})
    camera.attached()
    assert [host.read(1, k) for k in range(81, 89)] == [0] * 8


# --- selection


def crop_writes(x, y, width, height):
    """What dv-processing writes for a region in the user's frame: both axes mirrored (observed)."""
    left, right, top, bottom = 640 - x - width, 639 - x, 480 - y - height, 479 - y
    return [
        (5, 0x3305, left >> 8), (5, 0x3306, left & 255), (5, 0x3307, right >> 8), (5, 0x3308, right & 255),
        (5, 0x3301, top // 8), (5, 0x3302, 0xFF << top % 8 & 0xFF),
        (5, 0x3303, bottom // 8), (5, 0x3304, 0xFF >> 7 - bottom % 8), (5, 0x3300, 0),
    ]  # fmt: skip


@given(data=st.data())
def test_a_crop_of_dv_processing_keeps_its_region(data):
    x, y = data.draw(st.integers(0, 639)), data.draw(st.integers(0, 479))
    width, height = data.draw(st.integers(1, 640 - x)), data.draw(st.integers(1, 480 - y))
    camera, host = running(crop_writes(x, y, width, height))
    events = scattered(3000)
    events["x"][:500] = np.clip(events["x"][:500] % 3 + x - 1, 0, 639)
    events["y"][:500] = np.clip(events["y"][:500] % 3 + y - 1, 0, 479)
    camera.offer(events)
    inside = [e for e in events.tolist() if x <= e[1] < x + width and y <= e[2] < y + height]
    assert sent_by(host).events == inside
    assert camera.counters.not_selected == len(events) - len(inside)
    assert camera.counters.balanced


def test_area_blocking_hides_blocks_of_32_pixels():
    camera, host = running([(5, 0x3200, 0), (5, 0x3205, 0x7F), (5, 0x3206, 0xFE)])
    camera.offer(scattered(20_000))
    seen = sent_by(host).events
    assert not [e for e in seen if e[1] >= 608 and e[2] >= 448]  # block (0, 0) of the mirrored chip
    hidden = camera.counters.not_selected
    assert hidden == sum(1 for e in scattered(20_000).tolist() if e[1] >= 608 and e[2] >= 448) > 20
    host.write(5, 0x3200, 2)
    camera.offer(scattered(100, start_us=30_000))
    assert camera.counters.not_selected == hidden


@pytest.mark.parametrize(
    ("code", "period", "sent"), [(0, 1, 1), (1, 2, 1), (2, 4, 2), (3, 4, 1), (4, 8, 4), (5, 1, 1), (6, 1, 1), (7, 8, 1)]
)
def test_sub_sampling(code, period, sent):
    events = scattered(4000)
    camera, host = running([(5, 0x3204, code | code << 3)])
    camera.offer(events)
    mirrored = [e for e in events.tolist() if (639 - e[1]) % period < sent and (479 - e[2]) % period < sent]
    assert sent_by(host).events == mirrored
    camera, host = running([(5, 0x3204, code | code << 3), (5, 0x3200, 6)])
    camera.offer(events)
    assert sent_by(host).events == events.tolist()


@pytest.mark.parametrize(("bits", "keeps"), [(0x20, (True,)), (0x10, (False,)), (0x40, (True, False)), (0x30, ())])
def test_polarities(bits, keeps):
    events = scattered(300)
    camera, host = running([(5, 0x3067, 0x80 | bits)])
    camera.offer(events)
    kept = [e for e in events.tolist() if e[3] in keeps]
    if bits == 0x40:
        kept = [(*e[:3], True) for e in kept]
    assert sent_by(host).events == kept


# --- registers of the sensor


@pytest.mark.parametrize(
    ("writes", "level"),
    [  # libcaer's presets: ON current, ranges; OFF current, levels
        ([(0x1C, 6), (0x0B, 6), (0x1E, 2), (0x12, 0x7D)], 15),
        ([(0x1C, 3), (0x0B, 6), (0x1E, 5), (0x12, 0x7D)], 12),
        ([(0x1C, 0), (0x0B, 6), (0x1E, 8), (0x12, 0x7D)], 9),
        ([(0x1C, 5), (0x0B, 4), (0x1E, 3), (0x12, 0x7F)], 5),
        ([(0x1C, 2), (0x0B, 4), (0x1E, 6), (0x12, 0x7F)], 2),
    ],
)
def test_presets_of_sensitivity_scale_both_thresholds(writes, level):
    camera, host = running()
    assert camera.sensor_factors == {}
    host.write_all([(5, address, value) for address, value in writes])
    expected = {} if level == 9 else {"threshold_on": 1 + 0.073 * (level - 9), "threshold_off": 1 + 0.073 * (level - 9)}
    assert dict(camera.sensor_factors) == pytest.approx(expected)
    assert camera.without_effect == {}


def test_any_bias_gives_a_positive_threshold_and_unmodelled_ones_are_named():
    camera, host = running()
    for value in (0, 1, 8, 9, 255):
        host.write_all([(5, address, value) for address in (0x0B, 0x0C, 0x12, 0x18, 0x1C, 0x1E)])
        assert all(0.3 < factor < 2 for factor in camera.sensor_factors.values())
    host.write(5, 0x12, 0x6F)  # as neuromorphic_drivers writes it
    assert len(camera.without_effect) == 4


@pytest.mark.parametrize(
    ("fixed", "ms", "us", "column", "interval", "rate_hz"),
    [  # as dv-processing writes its rates, whose names are rounded: the last is 65 us
        (1, 9, 100, 15, 45000, 100), (1, 4, 100, 15, 45000, 200), (1, 1, 100, 15, 45000, 500),
        (1, 0, 100, 15, 45000, 1000), (1, 0, 1, 5, 24950, 2000), (1, 0, 1, 5, 9950, 5000), (1, 0, 1, 5, 4950, 10000),
        (0, 0, 307, 15, 45000, 2000), (0, 0, 7, 15, 45000, 5000), (0, 0, 10, 7, 45000, 10000),
        (0, 0, 1, 5, 45000, 15000),
    ],
)  # fmt: skip
def test_the_period_of_a_scan_gives_each_named_rate(fixed, ms, us, column, interval, rate_hz):
    camera, host = running()
    writes = [(0x325C, fixed), (0x3240, ms), (0x3241, us >> 8), (0x3242, us & 255), (0x3261, 0), (0x3262, column)]
    writes += [(0x325D, interval >> 8), (0x325E, interval & 255)]
    host.write_all([(5, address, value) for address, value in writes])
    assert camera.scan_us == pytest.approx(1e6 / rate_hz, rel=0.03)
    assert camera.sensor_factors.get("scan_us", 1.0) == pytest.approx(camera.scan_us / 199)


# --- inertial unit and external input


def samples(n, start_us=1000, scale=0xEA, period_us=1250):
    counts = np.random.default_rng(0).integers(-32768, 32768, (n, 7))
    return samples_at(start_us + period_us * np.arange(n), counts, scale)


def test_samples_go_out_in_the_axes_of_the_unit():
    camera, host = running(MEASURE, imu_unit=3)
    told = samples(3)
    assert camera.offer_readings(IMU, told)
    camera.offer(scattered(10, start_us=900))
    camera.advance(6000)
    data = host.data()
    reader = read(data)
    assert reader.wrong == []
    for (t_us, scale, octets), one in zip(reader.samples, told, strict=True):
        ay, ax, az, temperature, gy, gx, gz = np.frombuffer(octets, ">i2").tolist()
        assert (t_us, scale) == (one["t"], 0xEA)
        assert [ax, ay, az, temperature, gx, gy, gz] == one["counts"].tolist()
    assert host.decoder.feed(data).imu.tobytes() == told.tobytes()
    assert camera.counters.readings["imu"].delivered == 3


@pytest.mark.parametrize(
    ("writes", "scale", "per_ms", "divider"),
    [
        ([], 0xEA, 4, 5),
        ([(3, 5, 0), (3, 8, 0)], 0xEA, 1, 40),
        ([(3, 8, 7)], 0xEA, 1, 1),
        ([(3, 7, 3), (3, 10, 4)], 0xFC, 4, 5),
        ([(3, 10, 7)], 0xEC, 4, 5),
        ([(3, 3, 0), (3, 5, 4)], 0xAA, 1, 5),
        ([(3, 2, 0), (3, 3, 0)], 0x2A, 4, 5),
    ],
)
def test_registers_of_the_inertial_unit(writes, scale, per_ms, divider):
    camera, host = running([*MEASURE, *writes], imu_unit=3)
    asked = ImuSettings(*camera.reading_settings(IMU))
    assert (asked.run, asked.unit, asked.scale, asked.per_ms, asked.divider) == (True, 3, scale, per_ms, divider)
    host.write(0, 0, 0)
    assert not ImuSettings(*camera.reading_settings(IMU)).run


def test_counts_in_physical_units():
    one = no_samples(1)
    one["scale"], one["counts"] = 0xEA, (8192, 0, -32768, 512, 16384, 0, 1)
    (read_back,) = physical(one, 3)
    assert read_back["acceleration_g"].tolist() == [1.0, 0.0, -4.0]
    assert read_back["temperature_c"] == 24.0
    assert read_back["rate_deg_s"].tolist() == [250.0, 0.0, 500 / 32768]


def test_edges_become_marks_in_the_order_of_time():
    camera, host = running([(4, 0, 1), (4, 1, 1), (4, 2, 1), (4, 3, 0)])
    edges = make_edges((1000, 1003), (2, 3))
    camera.offer_edges(edges)
    camera.offer(events_of((999, 1, 1, True), (1000, 2, 2, True), (1002, 3, 3, True)))
    camera.advance(2000)
    data = host.data()
    assert read(data).marks == [(1000, 3), (1003, 2)]
    codes = [word for word in np.frombuffer(data, "<u2").tolist() if word < 0x2000]
    assert codes == [0x1801, 3, 0x1002, 0x1003, 2]
    assert camera.counters.edges.delivered == 2


# --- wrong data


@given(
    requests=st.lists(
        st.tuples(
            st.sampled_from([0x40, 0xC0, 0x41, 0x20, 0x00, 0x80, 0x02]),
            st.sampled_from([0xBF, 0xC2, 0xB1, 0xC6, 0xC7, 0x55, 0, 1, 6, 9]),
            st.integers(0, 0xFFFF) | st.sampled_from([0, 1, 3, 4, 5, 6, 9]),
            st.integers(0, 0xFFFF) | st.sampled_from([0x3000, 0x3067, 0x3200, 0x3204, 0x3205, 0x3300, 0x3303, 0x325D]),
            st.binary(max_size=12),
        ),
        max_size=30,
    )
)
def test_any_requests_leave_a_camera_that_counts_and_starts_again(requests):
    camera, host = running(imu_unit=3)
    now_us = 0
    for kind, request, value, index, data in requests:
        with suppress(Stall):
            assert len(host.control(kind, request, value, index, data)) <= len(data)
        now_us += 1000
        camera.offer_readings(IMU, samples(1, start_us=now_us))
        camera.offer(scattered(5, start_us=now_us))
        camera.advance(now_us + 10)
        assert camera.counters.balanced
        assert all(0.1 <= factor <= 1000 for factor in camera.sensor_factors.values())
        assert camera.scan_us >= 0
    camera.attached()
    host = Host(camera)
    host.write_all(RUN)
    last = scattered(50, start_us=now_us + 1000)
    camera.offer(last)
    assert sent_by(host).events == [(t - camera.epoch_us, x, y, on) for t, x, y, on in last.tolist()]


@pytest.mark.parametrize(
    ("field", "value"), [("serial", ""), ("size", (346, 260)), ("imu_unit", 2), ("fifo_bytes", 1000), ("pulse_us", 0)]
)
def test_settings_that_it_cannot_have(field, value):
    with pytest.raises(ValueError, match=r"serial|640 x 480|imu_unit|small|pulse_us"):
        Dvxplorer(DvxplorerSettings(**{field: value}))
