"""A USB device port in memory: FunctionFS on the camera's side, a driver's host on the other.

As Linux does it: the kernel answers standard requests itself and tells of them as events; an endpoint carries one
write at a time, in packets; a request that the host gave up cancels its data stage.
"""

import asyncio
import errno
import threading
import time
from collections import deque

from firmware_protocol.usb.control import StandardControl
from firmware_protocol.usb.device import Identity, RequestKind, Stall
from firmware_protocol.usb.functionfs import Event, EventKind
from transports.usb.functionfs.cable import Cable
from transports.usb.host import StallError, TransferTimeout

PACKET_BYTES = 1024
PATIENCE_S = 120.0


class PortControl:
    """Endpoint 0, both sides."""

    def __init__(self):
        self.changed = threading.Condition()
        self.events = deque()
        self._woken = False
        self._asked = None  # the request that the camera works on
        self._replies = {}
        self._given_up = set()
        self._data = {}

    # The camera's side.

    def next_event(self):
        with self.changed:
            self.changed.wait_for(lambda: self.events or self._woken)
            if self._woken:
                return None
            event = self.events.popleft()
            self._asked = event if event.setup else self._asked
            return event

    def wake(self):
        with self.changed:
            self._woken = True
            self.changed.notify_all()

    def send(self, data):
        self._reply(data)

    def receive(self, length):
        data = self._data[id(self._asked)]
        assert len(data) == length
        self._reply(b"")
        return data

    def refuse(self, *, is_in):
        assert self._asked is not None
        assert self._asked.setup.is_in == is_in
        self._reply(Stall())

    def _reply(self, reply):
        with self.changed:
            if id(self._asked) in self._given_up:
                raise OSError(errno.EIDRM, "the host gave up")
            self._replies[id(self._asked)] = reply
            self.changed.notify_all()

    # The host's side.

    def happen(self, kind):
        with self.changed:
            self.events.append(Event(kind))
            self.changed.notify_all()

    def ask(self, setup, data, timeout_s):
        event = Event(EventKind.SETUP, setup)
        with self.changed:
            self._data[id(event)] = data
            self.events.append(event)
            self.changed.notify_all()
            if not self.changed.wait_for(lambda: id(event) in self._replies, timeout_s):
                self._given_up.add(id(event))
                self._data[-id(event)] = event  # so that its id is not given again
                raise TransferTimeout("no answer")
            reply = self._replies.pop(id(event))
        if isinstance(reply, Stall):
            raise StallError("refused")
        return reply


class PortPipe:
    """One endpoint, both sides."""

    def __init__(self, address):
        self.number, self.is_in = address & 15, bool(address & 0x80)
        self.changed = threading.Condition()
        self.enabled = self.halted = False
        self._written = None
        self._interrupted = False
        self._sent = deque()
        self._urb = b""

    # The camera's side.

    def packet_bytes(self):
        return PACKET_BYTES

    def write(self, data):
        with self.changed:
            self._require_host(errno.EAGAIN)
            self._written, self._interrupted = data, False
            self.changed.notify_all()
            self.changed.wait_for(lambda: self._written is None or not self.enabled or self._interrupted)
            if self._written is None:
                return
            self._written = None
            self._require_host(errno.ESHUTDOWN)
            raise InterruptedError(errno.EINTR, "a signal came")

    def read(self, most_bytes):
        with self.changed:
            self._require_host(errno.EAGAIN)
            self._interrupted = False
            self.changed.wait_for(lambda: self._sent or not self.enabled or self._interrupted)
            self._require_host(errno.ESHUTDOWN)
            if not self._sent:
                raise InterruptedError(errno.EINTR, "a signal came")
            return self._sent.popleft()

    def halt(self):
        with self.changed:
            self.halted = True
            self.changed.notify_all()

    def interrupt(self):
        with self.changed:
            self._interrupted = True
            self.changed.notify_all()

    def _require_host(self, number):
        if not self.enabled:
            raise OSError(number, "no host")

    # The host's side.

    def enable(self, enabled):
        with self.changed:
            self.enabled, self._urb = enabled, b""
            self.halted = False
            self.changed.notify_all()

    def clear_halt(self):
        with self.changed:
            self.halted = False

    def give(self, data):
        with self.changed:
            self._sent.append(data)
            self.changed.notify_all()

    def take(self, length, timeout_s):
        """Do one transfer of the host; what of it has come when time is out comes with the next."""
        deadline_s = time.monotonic() + timeout_s
        with self.changed:
            while True:
                ready = self.changed.wait_for(
                    lambda: self._written is not None or self.halted, max(0.0, deadline_s - time.monotonic())
                )
                if self.halted:
                    raise StallError("halted")
                if not ready:
                    return None
                part = self._written[: length - len(self._urb)]
                rest = self._written[len(part) :]
                self._written = rest or None
                self._urb += part
                self.changed.notify_all()
                if len(self._urb) == length or len(part) % PACKET_BYTES or not part:
                    urb, self._urb = self._urb, b""
                    return urb


class Port:
    """A port of a device with these descriptors; see `FunctionFiles`."""

    def __init__(self, descriptors):
        self.descriptors = descriptors
        self.control = PortControl()
        self.pipes = [PortPipe(address) for address in sorted(descriptors.configuration.endpoint_addresses)]

    def pipe(self, address):
        (found,) = (p for p in self.pipes if p.number == address & 15 and p.is_in == bool(address & 0x80))
        return found

    def turn(self, kind):
        for pipe in self.pipes:
            pipe.enable(kind is EventKind.ENABLE)
        self.control.happen(kind)


class PortReader:
    """See `BulkReader`."""

    def __init__(self, pipe, transfer_bytes):
        self._pipe, self._bytes = pipe, transfer_bytes

    def read(self, timeout_s):
        return self._pipe.take(self._bytes, timeout_s)

    def close(self):
        return []


class PortHost:
    """A driver at the port; closing it pulls the cable."""

    def __init__(self, port, timeout_s):
        self._port, self._timeout_s = port, timeout_s
        self._kernel = StandardControl(port.descriptors)
        self._is_open = True
        port.control.happen(EventKind.BIND)

    @property
    def identity(self):
        device = self._port.descriptors.device
        return Identity(device.vendor_id, device.product_id, device.bcd_device, device.speed)

    def configure(self):
        self._port.turn(EventKind.ENABLE)

    def clear_halt(self, endpoint):
        self._port.pipe(0x80 | endpoint).clear_halt()

    def control_in(self, setup):
        if setup.kind is RequestKind.STANDARD:
            return self._kernel.control(setup, b"")
        return self._port.control.ask(setup, b"", self._timeout_s)

    def control_out(self, setup, data=b""):
        self._port.control.ask(setup, data, self._timeout_s)
        return len(data)

    def bulk_out(self, endpoint, data):
        self._port.pipe(endpoint).give(data)

    def bulk_in(self, endpoint, length):
        data = self._port.pipe(0x80 | endpoint).take(length, self._timeout_s)
        if data is None:
            raise TransferTimeout("nothing came")
        return data

    def stream(self, endpoint, transfer_bytes=131_072, transfers=32):
        return PortReader(self._port.pipe(0x80 | endpoint), transfer_bytes)

    def close(self):
        if self._is_open:
            self._is_open = False
            self._port.turn(EventKind.DISABLE)


class GadgetBench:
    """A loop in a thread of its own with a cable between a device and a port."""

    def __init__(self):
        self.loop = asyncio.new_event_loop()
        self.faults = []
        self.loop.set_exception_handler(lambda loop, context: self.faults.append(context))
        self._thread = threading.Thread(target=self.loop.run_forever)
        self._thread.start()
        self.cable = None

    def run(self, coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(PATIENCE_S)

    def plug(self, device, descriptors, grace_s=0.05):
        port = self.port = Port(descriptors)

        async def begin():
            self.cable = Cable(device, port, grace_s)
            self.cable.start()

        self.unplug()
        self.run(begin())
        return port

    def call(self, function, *args):
        async def called():
            result = function(*args)
            self.cable.pump()
            return result

        return self.run(called())

    def until(self, good):
        """Let the cable work until `good`, asked in its thread, is true."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not self.call(good):
            assert time.monotonic() < deadline_s, "in vain"
            time.sleep(0.001)

    def unplug(self, linger_s=0.2):
        """End the cable, as the end of a run does."""
        if self.cable is not None:
            cable, self.cable = self.cable, None
            self.run(cable.close(lambda: self.port.turn(EventKind.UNBIND), linger_s=linger_s))

    def close(self):
        self.unplug()
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()
        assert not self.faults
