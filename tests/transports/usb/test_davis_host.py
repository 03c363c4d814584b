"""A driver's whole life with our own camera, over USB/IP."""

import numpy as np
import pytest

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.davis346.registers import Layout
from firmware_protocol.davis346.words import WordEncoder
from firmware_protocol.events import EVENT
from firmware_protocol.fx3.registers import SystemInfo
from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import Identity
from tests.made_events import scattered
from transports.usb.davis_host import DavisHost
from transports.usb.host import PeerGone, StreamSettings, TransferTimeout, UnsuitableDevice
from transports.usb.usbip.client import UsbipHost

pytestmark = pytest.mark.socket

SMALL = StreamSettings(transfer_bytes=8192, transfers=8)


def events(n, start_us, seed=1):
    return scattered(start_us + np.sort(np.random.default_rng(seed).integers(0, 20_000, n)), seed=seed)


@pytest.fixture
def cable(bench):
    """Gives open(camera) -> host, and play(events, now_us), which makes the camera see them."""

    def open_camera(camera):
        bench.start({"1-1": camera})

        def play(batch, now_us):
            camera.offer(batch)
            camera.advance(now_us)
            bench.server.pump()

        return UsbipHost(bench.connect(), "1-1", timeout_s=120), lambda *args: bench.call(play, *args)

    return open_camera


def read_all(driver, n):
    parts = [np.zeros(0, EVENT)]
    while sum(map(len, parts)) < n:
        part = driver.read(120)
        assert part is not None, f"{sum(map(len, parts))} of {n} events"
        parts.append(part)
    return np.concatenate(parts)


@pytest.mark.parametrize("layout", Layout)
def test_identifies_the_camera(cable, layout):
    host, _ = cable(Davis346(Davis346Settings(serial="00000042", layout=layout)))
    driver = DavisHost(host)
    info = driver.info
    assert (info.serial, info.firmware, info.logic_version, info.chip_id) == ("00000042", 6, 18, 5)
    assert (info.size, info.turned, info.timestamp_master) == ((346, 260), layout is Layout.TURNED, True)
    driver.close()


@pytest.mark.parametrize("layout", Layout)
def test_every_event_arrives_as_it_was(cable, layout):
    camera = Davis346(Davis346Settings(layout=layout))
    host, play = cable(camera)
    driver = DavisHost(host)
    play(events(10, 0), 100_000)
    driver.start(SMALL)
    sent = [events(5000, 100_000 + 20_000 * k, k) for k in range(5)]
    for batch in sent:
        play(batch, int(batch["t"][-1]) + 1)
    received = read_all(driver, 25_000)
    expected = np.concatenate(sent)
    expected["t"] -= 100_000
    assert np.array_equal(received, expected)
    assert driver.faults.total == 0
    assert len(driver.stop()) == 0
    driver.close()
    assert (camera.counters.delivered, camera.counters.not_running) == (25_000, 10)


class Scripted:
    """A reader that gives what it was given."""

    def __init__(self, *transfers):
        self._transfers = list(transfers)

    def read(self, timeout_s):
        return self._transfers.pop(0) if self._transfers else None

    def close(self):
        return self._transfers


def test_events_before_the_timestamp_reset_are_thrown_away(cable, monkeypatch):
    """A real camera may send the reset in the middle of a transfer."""
    encoder = WordEncoder()
    early, last, late = (events(50, 0, seed) for seed in (1, 2, 3))
    last["t"] += early["t"][-1] + 1
    pieces = [encoder.encode(early).words, encoder.encode(last).words, encoder.reset(), encoder.encode(late).words]
    first, *rest = (piece.tobytes() for piece in pieces)
    host, _ = cable(Davis346())
    driver = DavisHost(host)
    monkeypatch.setattr(host, "stream", lambda *_: Scripted(first, b"".join(rest)))
    driver.start(SMALL)
    assert np.array_equal(driver.read(0), late)
    assert driver.read(0) is None
    driver.close()


def test_without_a_timestamp_reset_the_camera_is_silent_first(cable):
    camera = Davis346(Davis346Settings(start_delay_us=10_000))
    host, play = cable(camera)
    driver = DavisHost(host)
    driver.start(StreamSettings(8192, 8, reset_timestamps=False))
    play(events(100, 0), 20_000)
    play(events(100, 20_000), 50_000)
    kept = camera.counters.delivered + camera.counters.queued
    assert 100 < kept < 200
    assert len(read_all(driver, kept)) == kept
    driver.close()


def test_stop_gives_what_was_under_way(cable):
    camera = Davis346()
    host, play = cable(camera)
    driver = DavisHost(host)
    driver.start(SMALL)
    play(events(1000, 0), 30_000)
    rest = driver.stop()
    # What had left the camera is here, what had not is in its books.
    assert len(rest) == camera.counters.delivered
    assert camera.counters.delivered + camera.counters.flushed == 1000
    driver.close()


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (Davis346Settings(bcd_device=0x0205), "firmware version 5; at least 6"),
        (Davis346Settings(system=SystemInfo(logic_version=17)), "logic version 17; exactly 18"),
        (Davis346Settings(system=SystemInfo(logic_patch=0)), "logic patch version 0"),
    ],
)
def test_refuses_what_other_drivers_refuse(cable, settings, says):
    host, _ = cable(Davis346(settings))
    with pytest.raises(UnsuitableDevice, match=says):
        DavisHost(host)


def test_refuses_another_camera(bench, device, monkeypatch):
    monkeypatch.setattr(type(device), "identity", Identity(1, 2, 6, Speed.SUPER))
    bench.start({"1-1": device})
    with pytest.raises(UnsuitableDevice, match="0001:0002 is not a DAVIS"):
        DavisHost(UsbipHost(bench.connect(), "1-1", timeout_s=120))
    device.wait_for("detached")


def test_camera_that_goes_away_while_streaming(bench):
    bench.start({"1-1": Davis346()})
    driver = DavisHost(UsbipHost(bench.connect(), "1-1", timeout_s=120))
    driver.start(SMALL)
    bench.run(bench.server.close(linger_s=0))
    with pytest.raises(PeerGone):
        driver.read(120)
    driver.close()


def test_reset_that_never_shows_is_a_timeout(bench, monkeypatch):
    monkeypatch.setattr("transports.usb.fx3_host._RESET_TIMEOUT_S", 0.05)
    camera = Davis346()
    monkeypatch.setattr(camera, "read", lambda endpoint, max_bytes: None)
    bench.start({"1-1": camera})
    driver = DavisHost(UsbipHost(bench.connect(), "1-1", timeout_s=120))
    with pytest.raises(TransferTimeout, match="timestamp reset"):
        driver.start(SMALL)
    driver.close()
