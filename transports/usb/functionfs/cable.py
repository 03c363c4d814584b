"""Connection between a device model and a function of FunctionFS, for the events of the port and the device's data.

    port       SETUP ----------> device.control, in the order of events at the port
               ENABLE ---------> device.attached, SET_CONFIGURATION
               DISABLE, UNBIND > device.detached
    endpoint   idle ----------->  device.read; sent, or lost when the host did not take it

Guarantees, beside those of `UsbDevice`:

- A host that reads nothing delays neither control requests nor the camera: one transfer for each endpoint waits for
  it, and the device itself drops and counts the data that it cannot store.
- When the host ends a stream, it has `grace_s` to read a transfer of that stream. Then the transfer is aborted, so that
  the next stream does not begin with it. The part that the host has read is not known: all of it counts as lost.
- The controller holds a halt: it ends when the host clears it, without a notification. The device is informed of its
  end at once.
- FunctionFS cannot refuse the data of an OUT request when they have arrived; `UsbDevice.accepts` can before.

The blocking calls of FunctionFS are made by threads: one for endpoint 0, one for each other endpoint.

    loop's thread                              other threads
    -------------                              -------------------------------------------
    device.control  <-- Request, EventKind --  ControlThread: events and data stages of endpoint 0
    device.read     --- transfer ----------->  InThread: write; reports if the host took it
    device.write    <-- data ----------------  OutThread: read

Only the loop's thread uses the device: requests of the other threads are put into the loop by `post`.
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
from transports.usb.functionfs.files import ControlFile, EndpointFile, FunctionFiles

log = logging.getLogger(__name__)

_TURNS = (EventKind.ENABLE, EventKind.DISABLE, EventKind.UNBIND)
_READ_BYTES = 16384
_JOIN_TIMEOUT_S = 10.0


@dataclass(frozen=True)
class Request:
    """Control request for the device. `data` is None while only the permission to receive its data is requested."""

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
    """Thread for endpoint 0: `post` receives each Request, which must be answered, and each event of the port."""

    def __init__(self, pipe: ControlFile, post: Callable[[Request | EventKind], None]) -> None:
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
        """End the thread and wait for it; its requests must still be answered."""
        self._pipe.wake()
        self.join(_JOIN_TIMEOUT_S)

    def _serve(self, setup: SetupPacket) -> None:
        """Execute one control transfer; if the host aborts it, the next one can begin."""
        try:
            try:
                self._transfer(setup)
            except Stall as stall:
                log.debug("STALL of %s: %s", setup, stall)
                self._pipe.refuse(is_in=setup.is_in)
        except OSError as error:
            log.debug("%s was aborted by the host: %s", setup, error)

    def _transfer(self, setup: SetupPacket) -> None:
        if setup.is_in:
            self._pipe.send(self._request(setup, b"")[: setup.length])
        elif setup.length:
            # After its data have arrived the request counts as done, so it must be refused before.
            self._request(setup, None)
            data = self._pipe.receive(setup.length)
            with contextlib.suppress(Stall):
                self._request(setup, data)
        else:
            self._request(setup, b"")
            self._pipe.receive(0)

    def _request(self, setup: SetupPacket, data: bytes | None) -> bytes:
        request = Request(setup, data)
        self._post(request)
        return request.answer.result()


class InThread(threading.Thread):
    """Thread that sends transfers to the host, one at a time, by the endpoint `pipe`.

    `done` is called in this thread at each transfer's end: with None, or with the error that ended it.
    """

    def __init__(self, pipe: EndpointFile, done: Callable[[InThread, OSError | None], None]) -> None:
        super().__init__(name=f"usb gadget IN {pipe.number}", daemon=True)
        self.pipe = pipe
        self._done = done
        self._jobs: queue.SimpleQueue[Transfer | Stall | None] = queue.SimpleQueue()
        self._is_aborted = False

    def put(self, job: Transfer | Stall) -> None:
        """Send a transfer to the host, or halt the endpoint; only after `done` was called for the preceding one."""
        self._is_aborted = False
        self._jobs.put(job)

    def abort(self) -> None:
        """Abort the transfer in progress; repeat until `done` is called, because a call may begin between two."""
        self._is_aborted = True
        self.pipe.interrupt()

    def run(self) -> None:
        """Serve until `end`."""
        while (job := self._jobs.get()) is not None:
            try:
                self._send(job)
            except OSError as error:
                self._done(self, error)
            else:
                self._done(self, None)

    def end(self) -> None:
        """End the thread when the transfer in progress has ended."""
        self._jobs.put(None)

    def _send(self, job: Transfer | Stall) -> None:
        if isinstance(job, Stall):
            self.pipe.halt()
            return
        if self._is_aborted:
            raise InterruptedError("aborted before it began")
        packet_bytes = self.pipe.packet_bytes()
        self.pipe.write(job.data)
        if job.data and len(job.data) % packet_bytes == 0:
            self.pipe.write(b"")  # only a short packet ends the host's transfer


class OutThread(threading.Thread):
    """Thread that receives transfers from the host: `post` gets each as a Sent, which must be answered."""

    def __init__(self, pipe: EndpointFile, post: Callable[[Sent], None]) -> None:
        super().__init__(name=f"usb gadget OUT {pipe.number}", daemon=True)
        self._pipe = pipe
        self._post = post
        self._enabled = threading.Event()
        self._is_over = False

    def enable(self) -> None:
        """Begin to read, because a host has selected the configuration."""
        self._enabled.set()

    def run(self) -> None:
        """Serve until `end`."""
        while self._enabled.wait() and not self._is_over:
            self._enabled.clear()  # first: the next host may connect before the read of this one has failed
            with contextlib.suppress(OSError):
                while not self._is_over:
                    self._take()

    def end(self) -> None:
        """End the thread."""
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
class _InProgress:
    """Transfer in progress, the number of streams that had ended before, and its deadline."""

    job: Transfer | Stall
    flushes: int
    until_s: float = math.inf


class Cable:
    """Service of one device at one function; made and used in a running asyncio loop.

    Parameters
    ----------
    device : the device behind the port.
    function : the port; its descriptors must have been accepted, and its controller be bound after `start`.
    grace_s : time in which the host may still read a transfer of an ended stream.

    Attributes
    ----------
    attend : function that is called before a request is processed.
    """

    def __init__(self, device: UsbDevice, function: FunctionFiles, grace_s: float = _GRACE_S) -> None:
        self._device = device
        self._loop = asyncio.get_running_loop()
        self._grace_s = grace_s
        self._control = ControlThread(function.control, self._soon(self._enqueue))
        self._ins = [InThread(p, self._soon(self._taken)) for p in function.pipes if p.is_in]
        self._outs = [OutThread(p, self._soon(self._enqueue)) for p in function.pipes if not p.is_in]
        # Requests and events of the port that are not processed yet, oldest first.
        self._orders: deque[Request | Sent | EventKind] = deque()
        self._on_the_way: dict[InThread, _InProgress] = {}
        self._is_attached = self._is_configured = self._is_closing = False
        self.enabled = False  # True while a host has selected the configuration
        self.attend: Callable[[], None] = lambda: None

    @property
    def idle(self) -> bool:
        """True when there is no host, and no work left."""
        return not self._on_the_way and not self._orders and not self.enabled

    def start(self) -> None:
        """Start the threads."""
        for thread in (self._control, *self._ins, *self._outs):
            thread.start()

    def pump(self) -> None:
        """Process the pending requests, and let idle endpoints send the data that the device has now."""
        while self._orders and self._processed(self._orders[0]):
            self._orders.popleft()
        self._give_up()
        if self.enabled and not self._orders and not self._is_closing:
            for thread in self._ins:
                if thread not in self._on_the_way:
                    self._carry(thread)

    async def close(self, unbind: Callable[[], None], linger_s: float = _LINGER_S) -> None:
        """Wait `linger_s` for transfers in progress, call `unbind`, which disconnects the host, and end."""
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
        """Return a function that calls `function` in the loop's thread, from any thread."""

        def call(*args: P.args, **kwargs: P.kwargs) -> None:
            self._loop.call_soon_threadsafe(lambda: function(*args, **kwargs))

        return call

    # Requests and events of the port.

    def _enqueue(self, order: Request | Sent | EventKind) -> None:
        self.attend()
        self._orders.append(order)
        self.pump()

    def _processed(self, order: Request | Sent | EventKind) -> bool:
        """Process a request or event; return False when it must wait."""
        if isinstance(order, EventKind):
            return self._port_changed(order)
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

    def _port_changed(self, turn: EventKind) -> bool:
        """Attach or detach a host when no transfer is in progress; those to a lost host have failed."""
        self.enabled = False
        if self._on_the_way:
            return False
        if turn is not EventKind.ENABLE or self._is_configured:
            self._detach()
        if turn is EventKind.ENABLE:
            self._attach()
            self._device.control(SetupPacket(0, StandardRequest.SET_CONFIGURATION, 1, 0, 0), b"")
            self.enabled = self._is_configured = True
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

    # Transfers to the host.

    def _carry(self, thread: InThread) -> None:
        """Send the device's data by an idle endpoint."""
        endpoint = thread.pipe.number
        try:
            job: Transfer | Stall | None = self._device.read(endpoint, _LARGEST_TRANSFER)
        except Stall as stall:
            job = stall
            end_of_halt = SetupPacket(
                Recipient.ENDPOINT, StandardRequest.CLEAR_FEATURE, Feature.ENDPOINT_HALT, _IN | endpoint, 0
            )
            self._device.control(end_of_halt, b"")
        if job is not None:
            self._on_the_way[thread] = _InProgress(job, self._device.flushes(endpoint))
            thread.put(job)

    def _taken(self, thread: InThread, error: OSError | None) -> None:
        """Process the end of a transfer of an endpoint."""
        job = self._on_the_way.pop(thread).job
        if isinstance(job, Transfer):
            (self._device.sent if error is None else self._device.lost)(job)
        if error is not None:
            log.debug("endpoint %d: %s", thread.pipe.number, error)
            # The port reports the next host.
            self.enabled &= error.errno not in _NO_HOST
        self.pump()

    def _give_up(self) -> None:
        """Abort expired transfers of ended streams; at once if the host is lost."""
        now_s = self._loop.time()
        turning = bool(self._orders) and isinstance(self._orders[0], EventKind)
        for thread, transfer in self._on_the_way.items():
            if self._device.flushes(thread.pipe.number) != transfer.flushes:
                transfer.until_s = min(transfer.until_s, now_s + self._grace_s)
            if turning or now_s >= transfer.until_s:
                thread.abort()
