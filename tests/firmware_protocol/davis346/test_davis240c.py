"""A DAVIS240C: its record, descriptors and words, against the published sources and libcaer's rules of decoding."""

import math
import struct

import numpy as np
import pytest
from davis_host import RUN, SENSORS, Host, events_of, steady

from firmware_protocol.davis346.biases import sensor_factors
from firmware_protocol.davis346.decoder import Decoder
from firmware_protocol.davis346.device import Davis240c, Davis240cSettings
from firmware_protocol.davis346.model import DAVIS240C
from firmware_protocol.davis346.registers import Layout
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.frames import LineKind, line_record
from firmware_protocol.usb.descriptors import DescriptorType, Speed
from transports.usb.davis_host import Davis240cHost
from transports.usb.host import StreamSettings
from transports.usb.loopback import DirectHost

# libcaer 3.3.15, davisCommonSendDefaultChipConfig: coarse and fine value as its words (15..12 coarse, 11..4 fine, then
# 0xF an N source, 0xD a P source, 0xB an N cascode), in the order of DAVIS240_CONFIG_BIAS_*.
WORDS = [0x427F, 0x5FFF, 0x400F, 0x5B9B, 0x573B, 0x6DBF, 0x5A4F, 0x690F, 0x23AD, 0x110D, 0x419D, 0x65BF, 0x531F, 0x450D,
         0x798D, 0x5FFF, 0x5FFF, 0x7D7F, 0x6FDF, 0x5FEF, 0x8410, 0x8410]  # fmt: skip
# Registers that report a part of the logic, and those that set it.
REPORTS = [(0, 80), (1, 10), (1, 30), (1, 40), (1, 50), (1, 60), (1, 80), (4, 10)]
SETTINGS = [(1, k) for k in range(11, 64)] + [(4, k) for k in range(11, 17)]
PROMPT = Davis240cSettings(start_delay_us=0, frames=True, imu_unit=1)


def inside(n, **times):
    """Events within 240 x 180."""
    events = steady(n, **times)
    events["x"] %= 240
    events["y"] %= 180
    return events


def running():
    camera = Davis240c(PROMPT)
    host = Host(camera)
    host.write_all(RUN)
    return camera, host


@pytest.mark.parametrize(("speed", "packet"), [(Speed.HIGH, "0002"), (Speed.FULL, "4000")])
def test_descriptors_are_those_of_the_published_firmware(speed, packet):
    found = Davis240c().descriptors(speed)
    # dscr.a51, with the version of firmware that libcaer needs
    device = "12 01 0002 00 00 00 40 2a15 1b84 0400 01 02 03 01"
    assert found.find(DescriptorType.DEVICE, 0) == bytes.fromhex(device)
    configuration = f"09 02 1900 01 01 00 80 c8  09 04 00 00 01 ff 00 00 00  07 05 82 02 {packet} 00"
    assert found.find(DescriptorType.CONFIGURATION, 0) == bytes.fromhex(configuration)
    assert found.find(DescriptorType.DEVICE_QUALIFIER, 0) == bytes.fromhex("0a 06 0002 00 00 00 40 01 00")
    assert found.find(DescriptorType.BOS, 0) is None
    assert found.find(DescriptorType.STRING, 2)[2:].decode("utf-16-le") == "DAViS FX2"


def test_its_system_registers():
    _, host = running()
    assert [host.read(6, k) for k in range(8)] == [18, 2, 1, 90, 30, 30, 1000, 1]
    assert [host.read(module, k) for module in (1, 2) for k in range(3)] == [240, 180, 0] * 2
    assert (host.read(3, 0), host.read(2, 6), host.read(9, 1)) == (1, 1, 30_000)


def test_bias_words_are_those_that_libcaer_writes():
    _, host = running()
    assert [host.read(5, k) for k in range(22)] == WORDS
    assert sensor_factors(dict(enumerate(WORDS)), DAVIS240C.biases, least_fine=DAVIS240C.least_fine) == dict.fromkeys(
        ("threshold_on", "threshold_off", "refractory_us", "corner_max_hz", "source_follower_hz"), 1.0
    )


@pytest.mark.parametrize(
    ("number", "word", "figure", "factor"),
    [
        (2, 0x401F, "threshold_off", math.log(39) / math.log(78)),
        (2, 0x400E, "threshold_off", 1000.0),
        (10, 0x432D, "refractory_us", 0.5),
        (8, 0x21DD, "corner_max_hz", 0.5),
        (9, 0x120D, "source_follower_hz", 2.0),
    ],
)
def test_a_bias_moves_its_figure(number, word, figure, factor):
    camera, host = running()
    host.write(5, number, word)
    changed = {name: value for name, value in camera.sensor_factors.items() if value != 1}
    assert changed == {figure: pytest.approx(factor)}


def test_parts_that_the_logic_lacks_read_zero_and_cannot_be_set():
    camera, host = running()
    host.multi_write([(*key, 0xFFFFFFFF) for key in (*REPORTS, *SETTINGS)])
    assert {host.read(*key) for key in (*REPORTS, *SETTINGS)} == {0}
    events = inside(5000, start_us=1)
    camera.offer(events)
    camera.advance(10_000)
    decoded = host.decoded()
    assert decoded.events.tolist() == events.tolist()
    assert not len(decoded.edges)
    assert {host.read(1, k) for k in range(81, 93)} == {0}


def test_words_of_the_corners():
    camera, host = running()
    camera.offer(events_of((5, 0, 0, False), (5, 239, 0, True), (7, 239, 179, False)))
    assert struct.unpack("<7H", host.data()) == (0x8005, 0x1000, 0x2000, 0x30EF, 0x8007, 0x10B3, 0x20EF)
    with pytest.raises(ValueError, match="outside the 240 x 180"):
        camera.offer(events_of((9, 240, 0, True)))


def frame_lines(reset, signal):
    """Lines of a frame of columns, `reset` and `signal` (height, width) in the user's frame."""
    height, width = reset.shape
    kinds = [LineKind.START, *[LineKind.RESET] * width, LineKind.EXPOSURE_START, LineKind.EXPOSURE_END]
    kinds += [*[LineKind.SIGNAL] * width, LineKind.END]
    lines = np.zeros(len(kinds), line_record(240))
    lines["t"], lines["kind"], lines["roi"] = 100 + 10 * np.arange(len(kinds)), kinds, (0, 0, width - 1, height - 1)
    for read, kind in ((reset, LineKind.RESET), (signal, LineKind.SIGNAL)):
        lines["samples"][lines["kind"] == kind, :height] = read.T
        lines["length"][lines["kind"] == kind] = height
    return lines


def as_libcaer_has_it(words, width, height):
    """Pixels (height, width) of 10 bits, by the rules of davis_common.h: columns in turn, samples doubled."""
    reads, at = {11: [], 12: []}, None
    for word in words:
        if word in reads:
            at = reads[word]
        elif word >> 12 == 4:
            at.append((word & 0xFFF) << 1)
    reset, signal = (np.array(reads[code]).reshape(width, height).T for code in (11, 12))
    return np.where((reset < 384) | (signal == 0), 1023, np.clip(reset - signal, 0, 1023))


def test_samples_are_halved_for_a_host_that_doubles_them():
    camera, host = running()
    host.write(2, 4, 1)
    rng = np.random.default_rng(2)
    reset, signal = rng.integers(700, 1000, (180, 240), np.uint16), rng.integers(2, 700, (180, 240), np.uint16)
    camera.offer_readings(ReadingKind.FRAMES, frame_lines(reset, signal))
    camera.advance(20_000)
    transfers = host.transfers(1 << 20)
    data = b"".join(one.data for one in transfers)
    words = np.frombuffer(data, "<u2").tolist()
    expected = (reset >> 1 << 1).astype(int) - (signal >> 1 << 1)
    np.testing.assert_array_equal(as_libcaer_has_it(words, 240, 180), expected)
    (frame,) = Decoder(DAVIS240C.size, sample_shift=1).feed(data).frames
    np.testing.assert_array_equal(frame.reset.astype(int) - frame.signal, expected)
    sent = [reading.record for one in transfers for reading in one.readings]
    kept = [record["samples"][0, :180] for record in sent if record["kind"][0] == LineKind.SIGNAL]
    np.testing.assert_array_equal(np.array(kept).T, signal >> 1 << 1)


def test_its_driver_reads_it():
    camera = Davis240c(PROMPT)
    driver = Davis240cHost(DirectHost(camera))
    assert (driver.info.chip_id, driver.info.size, driver.info.firmware) == (2, (240, 180), 4)
    driver.start(StreamSettings(edges=True))
    events = inside(3000, start_us=camera.now_us + 1)
    offset_us = camera.epoch_us
    camera.offer(events)
    got = driver.read(1.0)
    got["t"] += offset_us
    assert got.tolist() == events.tolist()
    assert driver.faults.total == 0


def test_every_source_runs_with_the_registers_that_drivers_write():
    camera, host = running()
    host.write_all(SENSORS)
    assert all(camera.reading_settings(kind)[0] for kind in ReadingKind)


@pytest.mark.parametrize("wrong", [{"layout": Layout.TURNED}, {"activity_filter": True}, {"imu_unit": 2}])
def test_settings_that_it_cannot_have_are_refused(wrong):
    with pytest.raises(ValueError, match=r"layout must be upright|no filters of activity|imu_unit 2"):
        Davis240cSettings(**wrong)
