"""The contract of links, over every kind that is built in, each with a real reader at its far end."""

import asyncio
import dataclasses
import multiprocessing
import queue
import threading
import time
from contextlib import suppress

import numpy as np
import pytest
import serial

from emulator.rig.kinds import LINKS
from emulator.rig.tables import Camera
from emulator.sensor.presets import PRESETS
from evstim.testing.link_contract import LinkContract, NoReader
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.receiver.can import CanReceiver
from firmware_protocol.receiver.instrument import SerialReceiver
from transports.can_bus.bus import PythonCanBus
from transports.can_bus.kind import CanLink
from transports.can_bus.node import peer_of
from transports.serial_line.kind import SerialLink
from transports.usb.cameras import driver_of
from transports.usb.kind import LoopbackLink, UsbipLink
from transports.usb.usbip.client import UsbipHost

pytestmark = pytest.mark.socket

START = multiprocessing.get_context
PATIENT = InstrumentSettings(housekeeping_s=0, queue_ms=60_000)


@pytest.fixture(autouse=True)
def links_as_users_have_them(request, forked_links, monkeypatch):
    """In one test of each kind the process of a link begins as it does for users."""
    if request.node.originalname == "test_every_event_arrives_in_order":
        monkeypatch.setattr(multiprocessing, "get_context", START)


class UsbipReader:
    """A driver in this process, attached over TCP."""

    def __init__(self, link):
        host, _, port = link.report.address.rpartition(":")
        self._camera = driver_of(UsbipHost.attach(host, int(port), "1-1", timeout_s=120.0))
        self._camera.start()

    def read(self, count):
        batches, have = [], 0
        while have < count:
            events = self._camera.read(120.0)
            assert events is not None, f"only {have} of {count} events came"
            batches.append(events)
            have += len(events)
        return np.concatenate(batches)

    def close(self):
        self._camera.close()


class _ReadAllTheTime:
    """A thread that reads, as a real computer's interrupt does, and hands on what has come."""

    def __init__(self, link):
        self._parts = queue.SimpleQueue()
        self._open = True
        self._thread = threading.Thread(target=self._read_on)
        self._thread.start()
        while self.absent in link.listen().state:
            time.sleep(0.01)

    def read(self, count):
        batches, have = [], 0
        while have < count:
            batches.append(self._parts.get(timeout=120.0))
            have += len(batches[-1])
        return np.concatenate(batches)

    def close(self):
        self._open = False
        self._thread.join()


class SerialReader(_ReadAllTheTime):
    """A computer that has opened the pty."""

    absent = "waiting"

    def __init__(self, link):
        self._receiver = SerialReceiver()
        self._port = serial.Serial(link.report.address, timeout=0.05)
        super().__init__(link)

    def _read_on(self):
        with suppress(OSError):  # the link has closed its side
            while self._open:
                if data := self._port.read(self._port.in_waiting or 1):
                    self._receiver.push(data)
                    self._parts.put(self._receiver.take_events())

    def close(self):
        super().close()
        self._port.close()


class CanReader(_ReadAllTheTime):
    """A computer that has joined the served bus."""

    absent = "no listener"

    def __init__(self, link, parameters):
        port = int(link.report.address.rpartition(":")[2])
        self._parameters = dataclasses.replace(peer_of(parameters), port=port)
        super().__init__(link)

    def _read_on(self):
        asyncio.run(self._join())

    async def _join(self):
        bus, receiver = PythonCanBus(self._parameters, "can0"), CanReceiver(self._parameters.receiver)
        await bus.open()
        with suppress(OSError):  # the link has closed the bus
            while self._open:
                for heard in bus.take():
                    receiver.push(heard.frame, heard.t_ns)
                    self._parts.put(receiver.take_events())
                    for reply in receiver.take_replies():
                        bus.send(reply)
                await bus.wait(0.05)
        await bus.close()


class TestUsbip(LinkContract):
    parameters = UsbipLink(port=0)

    def reader(self, link):
        return UsbipReader(link)


@pytest.mark.long
class TestLoopback(LinkContract):
    parameters = LoopbackLink()

    def reader(self, link):
        return NoReader()


DVXPLORER = Camera(model="dvxplorer", sensor=PRESETS["dvxplorer_micro"], start_delay_ms=0.0)


@pytest.mark.long
class TestDvxplorerOnUsbip(TestUsbip):
    camera = DVXPLORER


@pytest.mark.long
class TestDvxplorerOnLoopback(TestLoopback):
    camera = DVXPLORER


class TestEvk4OnLoopback(TestLoopback):
    camera = Camera(model="evk4", sensor=PRESETS["imx636"], start_delay_ms=0.0)


@pytest.mark.long
class TestGen31OnLoopback(TestLoopback):
    camera = Camera(model="silkyevcam_vga", sensor=PRESETS["gen31"], start_delay_ms=0.0)


@pytest.mark.long
class TestGenx320OnLoopback(TestLoopback):
    camera = Camera(model="genx320", sensor=PRESETS["genx320"], start_delay_ms=0.0)


@pytest.mark.system
class TestSerial(LinkContract):
    parameters = SerialLink(baud=12_000_000, instrument=PATIENT)

    def reader(self, link):
        return SerialReader(link)


@pytest.mark.system
class TestCan(LinkContract):
    parameters = CanLink(port=0, instrument=PATIENT, share=1.0)
    many, some = 4000, 2000  # a bus at 1 Mbit/s carries some 15 000 events a second

    def reader(self, link):
        return CanReader(link, self.parameters)


@pytest.mark.long
class TestCanIsoTp(TestCan):
    parameters = CanLink(port=0, instrument=PATIENT, share=1.0, carriage="isotp", answer_ms=60_000)


def test_every_built_in_kind_is_under_contract():
    under = {case.parameters.kind for case in (TestUsbip, TestLoopback, TestSerial, TestCan)}
    under |= {"usb_gadget"}  # needs a USB device controller: tests/guest/test_gadget.py
    # in tests/transports/file, gige, ros2, network_streams and udp_packets
    under |= {"file", "gige", "ros2", "tcp", "udp", "udp_packets"}
    assert under == {name for name in LINKS if name in LINKS._built_in}
