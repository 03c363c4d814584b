"""The cable between a device model and a function of FunctionFS: what the port does, and what the device has to say.

    port       SETUP ----------> device.control, in the order in which things happen at the port
               ENABLE ---------> device.attached, SET_CONFIGURATION
               DISABLE, UNBIND > device.detached
    endpoint   idle ----------->  device.read; sent, or lost when the host did not take it

What is promised, beside `UsbDevice`:

- A host that takes nothing holds up no control request and not the camera: one transfer for each endpoint waits for
  it, and what the device cannot keep it drops and counts itself.
- When the host ends a stream, a transfer of that stream has `grace_s` to be taken and is then given up, so that the
  next stream does not begin with it. How much of it the host has read nobody knows: all of it counts as lost.
- A halt is the controller's: it ends when the host clears it, and nobody is told. The device hears of its end at once.
- FunctionFS cannot refuse the data of an OUT request when they have come; `UsbDevice.accepts` can before.

The threads that make blocking calls of FunctionFS: one for endpoint 0, one for each other endpoint.

    loop's thread                              their threads
    -------------                              -------------------------------------------
    device.control  <-- Request, Turn -------  ControlThread: events and data stages of endpoint 0
    device.read     --- transfer ----------->  InThread: write; tells whether the host took it
    device.write    <-- data ----------------  OutThread: read

The device is used in the loop's thread alone: what a thread wants of it is put into the loop by `post`.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import math
import queue
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import ParamSpec

from firmware_protocol.usb.control import Feature, Recipient, StandardRequest
from firmware_protocol.usb.device import NotReady, SetupPacket, Stall, Transfer, UsbDevice
from firmware_protocol.usb.functionfs import EventKind
from transports.usb.functionfs.files import ControlPipe, DataPipe, Function

__all__ = ["Cable", "ControlThread", "InThread", "OutThread", "Request", "Sent"]


log = logging.getLogger(__name__)

_TURNS = (EventKind.ENABLE, EventKind.DISABLE, EventKind.UNBIND)
_READ_BYTES = 16384
_JOIN_TIMEOUT_S = 10.0


@dataclass(frozen=True)
class Request:
    """A control request for the device. `data` is None while it is asked only whether its data may come."""

    setup: SetupPacket
    data: bytes | None
    answer: Future[bytes] = field(default_factory=Future)


@dataclass(frozen=True)
class Sent:
    """Data for the device, of one OUT endpoint."""

    endpoint: int
    data: bytes
    answer: Future[bytes] = field(default_factory=Future)


class ControlThread(threading.Thread):
    """Serves endpoint 0: `post` gets each Request, to be answered, and each turn of the port."""

    def __init__(self, pipe: ControlPipe, post: Callable[[Request | EventKind], None]) -> None:
        super().__init__(name="usb gadget ep0", daemon=True)
        self._pipe = pipe
        self._post = post

    def run(self) -> None:
        """Serve until `end`."""
        while (event := self._pipe.next_event()) is not None:
            if event.setup is not None:
                self._serve(event.setup)
            elif event.kind in _TURNS:
                self._post(event.kind)

    def end(self) -> None:
        """Let the thread end and wait for it; what it asks for must be answered."""
        self._pipe.wake()
        self.join(_JOIN_TIMEOUT_S)

    def _serve(self, setup: SetupPacket) -> None:
        """Do one control transfer; a host that gives up meanwhile has the next one begin."""
        try:
            try:
                self._transfer(setup)
            except Stall as stall:
                log.debug("STALL of %s: %s", setup, stall)
                self._pipe.refuse(is_in=setup.is_in)
        except OSError as error:
            log.debug("%s was given up: %s", setup, error)

    def _transfer(self, setup: SetupPacket) -> None:
        if setup.is_in:
            self._pipe.send(self._asked(setup, b"")[: setup.length])
        elif setup.length:
            # When the data have come the request counts as done, so it must be refused before.
            self._asked(setup, None)
            data = self._pipe.receive(setup.length)
            with contextlib.suppress(Stall):
                self._asked(setup, data)
        else:
            self._asked(setup, b"")
            self._pipe.receive(0)

    def _asked(self, setup: SetupPacket, data: bytes | None) -> bytes:
        request = Request(setup, data)
        self._post(request)
        return request.answer.result()


class InThread(threading.Thread):
    """Gives transfers to the host, one at a time.

    Parameters
    ----------
    pipe
        The endpoint.
    done
        Hears, in this thread, of each transfer's end: None, or the error that it ended with.
    """

    def __init__(self, pipe: DataPipe, done: Callable[[InThread, OSError | None], None]) -> None:
        super().__init__(name=f"usb gadget IN {pipe.number}", daemon=True)
        self.pipe = pipe
        self._done = done
        self._jobs: queue.SimpleQueue[Transfer | Stall | None] = queue.SimpleQueue()
        self._is_void = False

    def put(self, job: Transfer | Stall) -> None:
        """Let a transfer go to the host, or the endpoint halt; only when `done` was told of the one before."""
        self._is_void = False
        self._jobs.put(job)

    def void(self) -> None:
        """Give up the transfer under way; call it again until `done` is told, for a call may begin between two."""
        self._is_void = True
        self.pipe.interrupt()

    def run(self) -> None:
        """Serve until `end`."""
        while (job := self._jobs.get()) is not None:
            try:
                self._carry(job)
            except OSError as error:
                self._done(self, error)
            else:
                self._done(self, None)

    def end(self) -> None:
        """Let the thread end when the transfer under way has ended."""
        self._jobs.put(None)

    def _carry(self, job: Transfer | Stall) -> None:
        if isinstance(job, Stall):
            self.pipe.halt()
            return
        if self._is_void:
            raise InterruptedError("given up before it began")
        packet_bytes = self.pipe.packet_bytes()
        self.pipe.write(job.data)
        if job.data and len(job.data) % packet_bytes == 0:
            self.pipe.write(b"")  # only a packet that is not full ends the host's transfer


class OutThread(threading.Thread):
    """Takes transfers from the host: `post` gets each as a Sent, to be answered."""

    def __init__(self, pipe: DataPipe, post: Callable[[Sent], None]) -> None:
        super().__init__(name=f"usb gadget OUT {pipe.number}", daemon=True)
        self._pipe = pipe
        self._post = post
        self._enabled = threading.Event()
        self._is_over = False

    def enable(self) -> None:
        """Begin to read: a host has chosen the configuration."""
        self._enabled.set()

    def run(self) -> None:
        """Serve until `end`."""
        while self._enabled.wait() and not self._is_over:
            self._enabled.clear()  # first: the next host may come before the read of this one has failed
            with contextlib.suppress(OSError):
                while not self._is_over:
                    self._take()

    def end(self) -> None:
        """Let the thread end."""
        self._is_over = True
        self._enabled.set()
        self._pipe.interrupt()

    def _take(self) -> None:
        sent = Sent(self._pipe.number, self._pipe.read(_READ_BYTES))
        self._post(sent)
        try:
            sent.answer.result()
        except Stall:
            self._pipe.halt()


# Even, and no multiple of a packet: it ends with a short packet, as the transfers of a camera do.
_LARGEST_TRANSFER = 65_534
_GRACE_S = 0.05
_LINGER_S = 1.0
_STEP_S = 0.002
_NO_HOST = (errno.ESHUTDOWN, errno.EAGAIN, errno.ENODEV)
_IN = 0x80

P = ParamSpec("P")


@dataclass
class _Carried:
    """What an endpoint carries, how many streams had ended before, and until when it may be taken."""

    job: Transfer | Stall
    flushes: int
    until_s: float = math.inf


class Cable:
    """Serves one device at one function; made and used in a running asyncio loop.

    Parameters
    ----------
    device
        What is behind the port.
    function
        The port; its descriptors must have been taken, and its controller be bound after `start`.
    grace_s
        How long a transfer of an ended stream may still be taken.
    """

    def __init__(self, device: UsbDevice, function: Function, grace_s: float = _GRACE_S) -> None:
        self._device = device
        self._loop = asyncio.get_running_loop()
        self._grace_s = grace_s
        self._control = ControlThread(function.control, self._soon(self._happened))
        self._ins = [InThread(p, self._soon(self._taken)) for p in function.pipes if p.is_in]
        self._outs = [OutThread(p, self._soon(self._happened)) for p in function.pipes if not p.is_in]
        # What happened at the port and is not dealt with yet, oldest first.
        self._orders: deque[Request | Sent | EventKind] = deque()
        self._on_the_way: dict[InThread, _Carried] = {}
        self._is_attached = self._is_configured = self._is_enabled = self._is_closing = False

    @property
    def enabled(self) -> bool:
        """True while a host has chosen the configuration."""
        return self._is_enabled

    @property
    def idle(self) -> bool:
        """True when there is no host, and nothing left to do."""
        return not self._on_the_way and not self._orders and not self._is_enabled

    def start(self) -> None:
        """Begin to serve."""
        for thread in (self._control, *self._ins, *self._outs):
            thread.start()

    def pump(self) -> None:
        """Deal with what happened, and let idle endpoints carry what the device has now."""
        self._deal()
        self._give_up()
        if self._is_enabled and not self._orders and not self._is_closing:
            for thread in self._ins:
                if thread not in self._on_the_way:
                    self._carry(thread)

    async def close(self, unbind: Callable[[], None], linger_s: float = _LINGER_S) -> None:
        """Give the host `linger_s` for what is on its way, call `unbind`, which takes the host away, and end."""
        self._is_closing = True
        await self._until(lambda: not self._on_the_way, linger_s)
        try:
            unbind()
        finally:
            await self._end_threads()

    async def _end_threads(self) -> None:
        await self._until(lambda: self.idle, 2 * _LINGER_S)
        for thread in self._ins:
            thread.end()
        for reader in self._outs:
            reader.end()
        ended = self._loop.run_in_executor(None, self._control.end)
        await self._until(ended.done, 20 * _LINGER_S)
        self._detach()

    async def _until(self, good: Callable[[], bool], patience_s: float) -> None:
        deadline_s = self._loop.time() + patience_s
        while self._loop.time() < deadline_s:
            self.pump()
            if good():
                return
            await asyncio.sleep(_STEP_S)

    def _soon(self, function: Callable[P, None]) -> Callable[P, None]:
        """Return what calls `function` in the loop's thread, from any thread."""

        def call(*args: P.args, **kwargs: P.kwargs) -> None:
            self._loop.call_soon_threadsafe(lambda: function(*args, **kwargs))

        return call

    # What happened at the port.

    def _happened(self, order: Request | Sent | EventKind) -> None:
        self._orders.append(order)
        self.pump()

    def _deal(self) -> None:
        while self._orders and self._dealt_with(self._orders[0]):
            self._orders.popleft()

    def _dealt_with(self, order: Request | Sent | EventKind) -> bool:
        """Do what an order asks for; False when it must wait."""
        if isinstance(order, EventKind):
            return self._turned(order)
        try:
            answer = self._obey(order)
        except NotReady as late:
            if not self._is_closing:
                return False
            order.answer.set_exception(Stall(f"no answer before the end: {late}"))
        except Stall as stall:
            order.answer.set_exception(stall)
        else:
            order.answer.set_result(answer)
        return True

    def _obey(self, order: Request | Sent) -> bytes:
        if isinstance(order, Sent):
            self._device.write(order.endpoint, order.data)
            return b""
        self._attach()
        if order.data is not None:
            return self._device.control(order.setup, order.data)
        if not self._device.accepts(order.setup):
            raise Stall(f"{order.setup} is not known, or its data have another length")
        return b""

    def _turned(self, turn: EventKind) -> bool:
        """Let a host come or go, when nothing is on its way any more; transfers to the host that went have failed."""
        self._is_enabled = False
        if self._on_the_way:
            return False
        if turn is not EventKind.ENABLE or self._is_configured:
            self._detach()
        if turn is EventKind.ENABLE:
            self._attach()
            self._device.control(SetupPacket(0, StandardRequest.SET_CONFIGURATION, 1, 0, 0), b"")
            self._is_enabled = self._is_configured = True
            for thread in self._outs:
                thread.enable()
        return True

    def _attach(self) -> None:
        if not self._is_attached:
            self._is_attached = True
            self._device.attached()

    def _detach(self) -> None:
        if self._is_attached:
            self._is_attached = self._is_configured = False
            self._device.detached()

    # What goes to the host.

    def _carry(self, thread: InThread) -> None:
        """Let an idle endpoint carry what the device has."""
        endpoint = thread.pipe.number
        try:
            job: Transfer | Stall | None = self._device.read(endpoint, _LARGEST_TRANSFER)
        except Stall as stall:
            job = stall
            self._device.control(_end_of_halt(endpoint), b"")
        if job is not None:
            self._on_the_way[thread] = _Carried(job, self._device.flushes(endpoint))
            thread.put(job)

    def _taken(self, thread: InThread, error: OSError | None) -> None:
        """Hear of the end of what an endpoint carried."""
        job = self._on_the_way.pop(thread).job
        if isinstance(job, Transfer):
            (self._device.sent if error is None else self._device.lost)(job)
        if error is not None:
            log.debug("endpoint %d: %s", thread.pipe.number, error)
            # The port will tell of the next host.
            self._is_enabled &= error.errno not in _NO_HOST
        self.pump()

    def _give_up(self) -> None:
        """End what is on its way of a stream that is over, when it had its time; at once where the host is gone."""
        now_s = self._loop.time()
        turning = bool(self._orders) and isinstance(self._orders[0], EventKind)
        for thread, carried in self._on_the_way.items():
            if self._device.flushes(thread.pipe.number) != carried.flushes:
                carried.until_s = min(carried.until_s, now_s + self._grace_s)
            if turning or now_s >= carried.until_s:
                thread.void()


def _end_of_halt(endpoint: int) -> SetupPacket:
    return SetupPacket(Recipient.ENDPOINT, StandardRequest.CLEAR_FEATURE, Feature.ENDPOINT_HALT, _IN | endpoint, 0)
