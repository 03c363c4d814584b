"""A receiver of a camera on USB/IP, in a process of its own, that reads and decodes everything until the run ends."""

from __future__ import annotations

import multiprocessing
import signal
import time
from contextlib import closing
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any, Self

from emulator.evaluation.bench.streams import BenchFailed
from transports.link.pacing import MonotonicClock
from transports.usb.cameras import CameraReception, driver_of, receive
from transports.usb.host import CameraHost, UsbHostError
from transports.usb.usbip.client import UsbipHost

__all__ = ["Received", "Receiver"]

_RETRY_S = 0.01
_CONNECT_S = 5.0
_END_S = 10.0


@dataclass(frozen=True)
class Received:
    """Counts of events and malformed words, and `time.monotonic` of the first event (None: there was none)."""

    events: int
    faults: int
    first_s: float | None


class Receiver:
    """The receiver of the camera at a port of this machine; it attaches as soon as the camera is there.

    The constructor returns when the process is ready to attach. A context manager: at its end the process has ended.

    Attributes
    ----------
    pid : of the process.
    """

    def __init__(self, port: int, patience_s: float) -> None:
        context = multiprocessing.get_context("spawn")
        self._mine, theirs = context.Pipe(duplex=False)
        self._process = context.Process(target=_serve, args=(port, patience_s, theirs), daemon=True)
        resource_tracker.ensure_running()  # its own start would let the signal through again
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # a Ctrl-C is for the bench
        try:
            self._process.start()  # which inherits the blocked signal
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        self.pid: int = self._process.pid or 0
        if not self._mine.poll(patience_s):  # its first message: its imports are done, and it can attach at once
            self.__exit__()
            raise BenchFailed("the receiver did not start")
        self._mine.recv()

    def received(self) -> Received:
        """Return the reception, once the camera has gone; raises BenchFailed."""
        if not self._mine.poll(_END_S):
            raise BenchFailed("the receiver did not attach before the run ended, or did not end with it")
        try:
            found: Received | str = self._mine.recv()
        except EOFError:
            raise BenchFailed("the receiver has died") from None
        if isinstance(found, str):
            raise BenchFailed(f"the receiver: {found}")
        return found

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.join()
        self._mine.close()


def _serve(port: int, patience_s: float, result: Connection) -> None:
    result.send(None)
    try:
        with closing(_attached(port, time.monotonic() + patience_s)) as camera:
            result.send(_read(camera))
    except UsbHostError as error:
        result.send(str(error))


def _attached(port: int, deadline_s: float) -> CameraHost[Any]:
    """Return the driver of the camera, which opens its port when it is ready; raises UsbHostError."""
    while True:
        try:
            return driver_of(UsbipHost.attach("127.0.0.1", port, "1-1", timeout_s=_CONNECT_S))
        except UsbHostError:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(_RETRY_S)


def _read(camera: CameraHost[Any]) -> Received:
    first_s: float | None = None

    def goes_on(now: CameraReception) -> bool:
        nonlocal first_s
        if first_s is None and now.events:
            first_s = time.monotonic()
        return True

    reception = receive(camera, goes_on, MonotonicClock())
    return Received(reception.events, reception.faults, first_s)
