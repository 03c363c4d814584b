"""What every link promises, each in its own process, with a real host at the other end."""

import os
import queue
import signal
import threading
import time
from contextlib import suppress
from functools import partial

import numpy as np
import pytest
import serial

from emulator.run.link_process import LinkFailed, LinkProcess
from firmware_protocol.davis346 import Davis346, Davis346Settings
from firmware_protocol.events import EVENT
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.receiver.serial import SerialReceiver
from transports.link.digest import digest_of
from transports.link.pacing import MonotonicClock
from transports.link.process import LinkSetup
from transports.link.ring import FREE_RUNNING, EventRing
from transports.serial_line.endpoint import SerialFactory
from transports.serial_line.parameters import SerialParameters
from transports.usb.davis_host import DavisHost
from transports.usb.loopback import LoopbackFactory
from transports.usb.usbip.client import UsbipHost
from transports.usb.usbip.endpoint import UsbipFactory

CAMERA = partial(Davis346, Davis346Settings(start_delay_us=0))
INSTRUMENT = partial(Instrument, (346, 260), InstrumentSettings(housekeeping_s=0))
ENDPOINTS = {
    "loopback": (CAMERA, LoopbackFactory()),
    "usbip": (CAMERA, UsbipFactory("127.0.0.1", 0, "1-1")),
    "serial": (INSTRUMENT, SerialFactory(SerialParameters(baud=12_000_000))),
}
pytestmark = pytest.mark.socket


def stream(count, start_us=0):
    rng = np.random.default_rng(start_us)
    events = np.zeros(count, EVENT)
    events["t"] = start_us + np.arange(count) * 3
    events["x"] = rng.integers(0, 346, count)
    events["y"] = rng.integers(0, 260, count)
    events["on"] = rng.integers(0, 2, count)
    return events


class NoHost:
    """The loopback link reads itself."""

    def __init__(self, link):
        pass

    def read(self, count):
        return None

    def close(self):
        pass


class UsbipReader:
    """A driver in this process, attached over TCP."""

    def __init__(self, link):
        host, _, port = link.report.address.rpartition(":")
        self._camera = DavisHost(UsbipHost.attach(host, int(port), "1-1", timeout_s=60.0))
        self._camera.start()

    def read(self, count):
        """Return the next `count` events, in device time."""
        batches, have = [], 0
        while have < count:
            events = self._camera.read(60.0)
            assert events is not None, f"only {have} of {count} events came"
            batches.append(events)
            have += len(events)
        return np.concatenate(batches)

    def close(self):
        self._camera.close()


class SerialReader:
    """A computer that has opened the pty and reads it all the time, as a real one's interrupt does."""

    def __init__(self, link):
        self._receiver = SerialReceiver()
        self._parts = queue.SimpleQueue()
        self._port = serial.Serial(link.report.address, timeout=0.05)
        self._open = True
        self._thread = threading.Thread(target=self._read_on)
        self._thread.start()
        while "waiting" in link.listen().state:
            time.sleep(0.01)

    def _read_on(self):
        with suppress(OSError):  # the link has closed its side
            while self._open:
                if data := self._port.read(self._port.in_waiting or 1):
                    self._parts.put(data)

    def read(self, count):
        """Return the next `count` events."""
        batches, have = [], 0
        while have < count:
            self._receiver.push(self._parts.get(timeout=60.0))
            batches.append(self._receiver.take_events())
            have += len(batches[-1])
        assert self._receiver.faults == 0
        return np.concatenate(batches)

    def close(self):
        self._open = False
        self._thread.join()
        self._port.close()


READERS = {"loopback": NoHost, "usbip": UsbipReader, "serial": SerialReader}


@pytest.fixture(params=ENDPOINTS)
def endpoint(request):
    return request.param


@pytest.fixture
def link(endpoint):
    setup = LinkSetup(endpoint, EventRing(20_000), *ENDPOINTS[endpoint])
    link = LinkProcess(setup, MonotonicClock())
    link.wait_ready()
    yield link
    link.stop(0.0)


@pytest.fixture
def reader(endpoint, link):
    reader = READERS[endpoint](link)
    yield reader
    reader.close()


def test_every_event_arrives_in_order(link, reader):
    events = stream(100_000)
    link.start(FREE_RUNNING)
    link.push_all(events, 300_000)
    received = reader.read(len(events))
    report = link.stop(60.0)
    assert (report.delivered, report.dropped, report.dropped_in_device) == (100_000, 0, 0)
    assert report.digest == digest_of(events)
    assert received is None or np.array_equal(received, events)


def test_a_paced_link_lets_events_go_at_their_time(link, reader):
    clock = MonotonicClock()
    events = stream(10_000)  # 30 ms of stream
    link.start(clock.now_ns() + 20_000_000)
    link.push(events, 30_000)
    reader.read(len(events))
    report = link.stop(60.0)
    assert report.delivered == 10_000
    assert report.latency.p50 is not None
    assert report.latency.p50 >= 0


def test_what_is_not_read_by_the_end_has_a_fate_too(link):
    link.start(FREE_RUNNING)
    link.push(stream(5000), 15_000)
    report = link.stop(0.5)
    assert report.delivered + report.dropped + report.dropped_in_device == 5000
    assert report.final


def test_a_full_link_does_not_hold_up_a_run_that_is_to_stop(link, reader):
    goes_on = iter([True] * 5 + [False] * 100)
    link.push_all(stream(50_000), 150_000, lambda: next(goes_on))  # the link was not started, so it takes nothing
    report = link.stop(0.2)
    assert report.delivered + report.dropped + report.dropped_in_device == 50_000
    assert report.dropped > 0


def test_a_process_that_dies_is_told(link):
    os.kill(link._process.pid, signal.SIGKILL)
    link._process.join(60.0)
    with pytest.raises(LinkFailed, match="ended"):
        link.listen()


def test_hosts_come_and_go():
    setup = LinkSetup("usbip", EventRing(), *ENDPOINTS["usbip"])
    link = LinkProcess(setup, MonotonicClock())
    link.wait_ready()
    link.start(FREE_RUNNING)
    now_us = 0
    for _ in range(3):
        reader = UsbipReader(link)
        events = stream(2000, now_us)
        now_us += 6000
        link.push_all(events, now_us)
        received = reader.read(len(events))
        assert np.array_equal(received["x"], events["x"])
        assert np.array_equal(np.diff(received["t"]), np.diff(events["t"]))
        reader.close()
    report = link.stop(1.0)
    assert report.delivered == 6000
    assert report.dropped == report.dropped_in_device == 0
