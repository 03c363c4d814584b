"""The threads that make blocking calls of FunctionFS: one for endpoint 0, one for each other endpoint.

    loop's thread                              their threads
    -------------                              -------------------------------------------
    device.control  <-- Request, Turn -------  ControlThread: events and data stages of endpoint 0
    device.read     --- transfer ----------->  InThread: write; tells whether the host took it
    device.write    <-- data ----------------  OutThread: read

The device is used in the loop's thread alone: what a thread wants of it is put into the loop by `post`.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field

from firmware_protocol.usb.device import SetupPacket, Stall, Transfer
from firmware_protocol.usb.functionfs import EventKind
from transports.usb.functionfs.function import ControlPipe, DataPipe

__all__ = ["ControlThread", "InThread", "OutThread", "Request", "Sent"]

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
