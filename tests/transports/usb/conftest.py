"""A USB device of a few lines, a USB/IP server in a thread of its own, and a USB bus behind pyusb."""

from __future__ import annotations

import array
import asyncio
import errno
import socket
import threading
from collections import deque
from types import SimpleNamespace

import pytest
import usb.backend
import usb.core
import usb.util

from firmware_protocol.usb.descriptors import DescriptorSet
from firmware_protocol.usb.device import Identity, SetupPacket, Speed, Stall, Transfer, UsbDevice
from transports.usb.usbip.connection import ConnectionSettings
from transports.usb.usbip.server import UsbipServer

STREAM_ENDPOINT = 2


class FakeDevice(UsbDevice):
    """Answers a descriptor request, keeps one register, and hands out the chunks it was given."""

    def __init__(self) -> None:
        self.log: list[str] = []
        self.chunks: deque[bytes] = deque()
        self.given: list[bytes] = []
        self.sent_data: list[bytes] = []
        self.lost_data: list[bytes] = []
        self.halted = False
        self.register = bytes(4)
        self.events = threading.Condition()

    def note(self, entry: str) -> None:
        with self.events:
            self.log.append(entry)
            self.events.notify_all()

    def wait_for(self, entry: str, times: int = 1) -> None:
        with self.events:
            assert self.events.wait_for(lambda: self.log.count(entry) >= times, 30), (entry, times, self.log)

    @property
    def identity(self) -> Identity:
        return Identity(0x152A, 0x841A, 0x0206, Speed.SUPER)

    def attached(self) -> None:
        self.note("attached")

    def detached(self) -> None:
        self.note("detached")

    def control(self, setup: SetupPacket, data: bytes) -> bytes:
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

    def read(self, endpoint: int, max_bytes: int) -> Transfer | None:
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
        return Transfer(chunk)

    def sent(self, transfer: Transfer) -> None:
        self.sent_data.append(transfer.data)
        self.note("sent")

    def lost(self, transfer: Transfer) -> None:
        self.lost_data.append(transfer.data)
        self.note("lost")


class ServerThread:
    """A USB/IP server whose event loop runs in another thread, so that a test can block on its sockets."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self.faults: list[dict] = []
        self.loop.set_exception_handler(lambda loop, context: self.faults.append(context))
        self._thread = threading.Thread(target=self.loop.run_forever)
        self._thread.start()
        self._sockets: list[socket.socket] = []
        self.server = UsbipServer({})

    def start(self, devices, settings=None, **kwargs):
        self.server = UsbipServer(devices, settings, **kwargs)
        self.run(self.server.start("127.0.0.1", 0))
        return self.server

    def run(self, coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(30)

    def call(self, function, *args):
        async def wrapped():
            return function(*args)

        return self.run(wrapped())

    def feed(self, device: FakeDevice, *chunks: bytes) -> None:
        def feed():
            device.chunks.extend(chunks)
            self.server.pump()

        self.call(feed)

    def connect(self) -> socket.socket:
        sock = socket.create_connection(("127.0.0.1", self.server.port), 30)
        self._sockets.append(sock)
        return sock

    def pair(self) -> socket.socket:
        ours, theirs = socket.socketpair()
        ours.settimeout(30)
        self._sockets.append(ours)
        self.run(self.server.serve(theirs))
        return ours

    def close(self) -> None:
        for sock in self._sockets:
            sock.close()
        self.run(self.server.close(linger_s=0))
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()


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
    bench.start({"1-1": device}, ConnectionSettings(operation_timeout_s=30))
    return bench


class Bus(usb.backend.IBackend):
    """A libusb that has one device, or one fault, on its bus."""

    def __init__(self, device: UsbDevice, descriptors: DescriptorSet) -> None:
        self.device = device
        self.changed = threading.Condition(threading.RLock())
        self.fault: int | None = None
        self._descriptors = descriptors

    def call(self, function, *args):
        """Do something to the device, as the process that owns it would."""
        with self.changed:
            result = function(*args)
            self.changed.notify_all()
            return result

    def break_with(self, number: int | None) -> None:
        """Every request fails with this errno from now on."""
        self.call(setattr, self, "fault", number)

    def check(self) -> None:
        if self.fault is not None:
            raise usb.core.USBError("fault", None, self.fault)

    def enumerate_devices(self):
        return ["handle"]

    def get_device_descriptor(self, dev):
        d = self._descriptors.device
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x300, bDeviceClass=0, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=9, idVendor=d.vendor_id, idProduct=d.product_id, bcdDevice=d.bcd_device,
            iManufacturer=1, iProduct=2, iSerialNumber=3, bNumConfigurations=1,
            address=2, bus=1, port_number=1, port_numbers=(1,), speed=4,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev, config):
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=44, bNumInterfaces=1, bConfigurationValue=1,
            iConfiguration=0, bmAttributes=0x80, bMaxPower=50, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev, intf, alt, config):
        if intf or alt:
            raise IndexError
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0, bNumEndpoints=1,
            bInterfaceClass=255, bInterfaceSubClass=0, bInterfaceProtocol=0, iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev, ep, intf, alt, config):
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=0x82, bmAttributes=2, wMaxPacketSize=1024, bInterval=0,
            bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev):
        self.check()
        self.device.attached()
        return "open"

    def close_device(self, handle):
        self.device.detached()

    def get_configuration(self, handle):
        return 0

    def set_configuration(self, handle, value):
        self.ctrl_transfer(handle, 0x00, 9, value, 0, usb.util.create_buffer(0), 0)

    def claim_interface(self, handle, intf):
        self.check()

    def release_interface(self, handle, intf):
        pass

    def clear_halt(self, handle, ep):
        self.ctrl_transfer(handle, 0x02, 1, 0, ep, usb.util.create_buffer(0), 0)

    def ctrl_transfer(self, handle, request_type, request, value, index, data, timeout):
        with self.changed:
            self.check()
            setup = SetupPacket(request_type, request, value, index, len(data))
            try:
                reply = self.device.control(setup, b"" if setup.is_in else data.tobytes())
            except Stall as stall:
                raise usb.core.USBError("stall", None, errno.EPIPE) from stall
            self.changed.notify_all()
        if setup.is_in:
            data[: len(reply)] = array.array("B", reply)
            return len(reply)
        return len(data)

    def bulk_read(self, handle, ep, intf, buff, timeout):
        transfers = []

        def ready() -> bool:
            if self.fault is None and (transfer := self.device.read(ep & 15, len(buff))):
                transfers.append(transfer)
            return bool(transfers) or self.fault is not None

        with self.changed:
            if not self.changed.wait_for(ready, timeout / 1000):
                raise usb.core.USBTimeoutError("timeout", None, errno.ETIMEDOUT)
            self.check()
            data = transfers[0].data
            buff[: len(data)] = array.array("B", data)
            self.device.sent(transfers[0])
        return len(data)


@pytest.fixture
def usb_bus():
    return Bus
