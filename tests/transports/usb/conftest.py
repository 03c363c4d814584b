"""A USB device of a few lines, a USB/IP server in a thread of its own, and a USB bus behind pyusb."""

import asyncio
import socket
import threading
import time
from collections import deque

import pytest

from evstim.testing.fake_usb import FakeUsbBus
from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import Identity, Stall, Transfer, UsbDevice
from transports.usb.usbip.connection import ConnectionSettings
from transports.usb.usbip.server import UsbipServer

STREAM_ENDPOINT = 2


class FakeDevice(UsbDevice):
    """Answers a descriptor request, keeps one register, and hands out the chunks it was given."""

    def __init__(self):
        self.log = []
        self.chunks = deque()
        self.given = []
        self.sent_data = []
        self.lost_data = []
        self.halted = False
        self.register = bytes(4)
        self.events = threading.Condition()

    def note(self, entry):
        with self.events:
            self.log.append(entry)
            self.events.notify_all()

    def wait_for(self, entry, times=1):
        with self.events:
            assert self.events.wait_for(lambda: self.log.count(entry) >= times, 120), (entry, times, self.log)

    @property
    def identity(self):
        return Identity(0x152A, 0x841A, 0x0206, Speed.SUPER)

    def attached(self):
        self.note("attached")

    def detached(self):
        self.note("detached")

    def control(self, setup, data):
        match setup.request:
            case 0x06:
                return bytes([18, 1, 0, 3, 0, 0, 0, 9, 0x2A, 0x15, 0x1A, 0x84, 0x06, 0x02, 1, 2, 3, 1])
            case 0x09:
                return b""
            case 0x0B:
                self.note("long answer")
                return bytes(setup.length)
            case 0xBF if setup.is_in:
                return self.register
            case 0xBF:
                self.register = data
                return b""
            case 0xEE:
                raise ValueError("a fault in the device model")
        raise Stall(f"unknown request {setup.request:#x}")

    def read(self, endpoint, max_bytes):
        if endpoint == 1:
            return None
        if endpoint != STREAM_ENDPOINT or self.halted:
            raise Stall("no such endpoint")
        if not self.chunks:
            return None
        chunk = self.chunks.popleft()
        if len(chunk) > max_bytes:
            self.chunks.appendleft(chunk[max_bytes:])
            chunk = chunk[:max_bytes]
        self.given.append(chunk)
        return Transfer(data=chunk)

    def sent(self, transfer):
        self.sent_data.append(transfer.data)
        self.note("sent")

    def lost(self, transfer):
        self.lost_data.append(transfer.data)
        self.note("lost")


class ServerThread:
    """A USB/IP server whose event loop runs in another thread, so that a test can block on its sockets."""

    def __init__(self):
        self.loop = asyncio.new_event_loop()
        self.faults = []
        self.loop.set_exception_handler(lambda loop, context: self.faults.append(context))
        self._thread = threading.Thread(target=self.loop.run_forever)
        self._thread.start()
        self._sockets = []
        self.server = UsbipServer({})

    def start(self, devices, settings=None, **kwargs):
        self.server = UsbipServer(devices, settings, **kwargs)
        self.run(self.server.start("127.0.0.1", 0))
        return self.server

    def run(self, coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(120)

    def call(self, function, *args):
        async def wrapped():
            return function(*args)

        return self.run(wrapped())

    def feed(self, device, *chunks):
        def feed():
            device.chunks.extend(chunks)
            self.server.pump()

        self.call(feed)

    def connect(self):
        sock = socket.create_connection(("127.0.0.1", self.server.port), 120)
        self._sockets.append(sock)
        return sock

    def pair(self):
        ours, theirs = socket.socketpair()
        ours.settimeout(120)
        self._sockets.append(ours)
        self.run(self.server.serve(theirs))
        return ours

    def close(self):
        for sock in self._sockets:
            sock.close()
        self.run(self.server.close(linger_s=0))
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()


@pytest.fixture
def impatient(monkeypatch):
    """Makes the next wait of a USB/IP host for an answer short, for one that is in vain; others last as before."""
    short_s = deque()

    def deadline(timeout_s):
        return time.monotonic() + (short_s.popleft() if short_s else timeout_s)

    monkeypatch.setattr("transports.usb.usbip.client._deadline", deadline)
    return lambda: short_s.append(0.1)


@pytest.fixture
def device():
    return FakeDevice()


@pytest.fixture
def new_device():
    return FakeDevice


@pytest.fixture
def bench():
    """A server thread that is not started yet."""
    thread = ServerThread()
    yield thread
    thread.close()


@pytest.fixture
def served(bench, device):
    """A server with one fake device at 1-1."""
    bench.start({"1-1": device}, ConnectionSettings(operation_timeout_s=120))
    return bench


@pytest.fixture
def usb_bus():
    return FakeUsbBus
