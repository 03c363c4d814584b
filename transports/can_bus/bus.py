"""Interface of a CAN bus, and its implementation by python-can.

`PythonCanBus` never blocks its caller: a separate thread reads the bus.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can

from firmware_protocol.can_frames.frame import Frame
from transports.can_bus.kind import CanLink
from transports.link.pacing import wall_less_monotonic_ns


class BusDown(OSError):
    """Error: a bus cannot be opened, or was lost; the message gives the remedy."""


@dataclass(frozen=True)
class TimedFrame:
    """Frame with its time on the bus (CLOCK_MONOTONIC, ns); `is_ours` marks an urgent frame of ours that was sent."""

    frame: Frame
    t_ns: int
    is_ours: bool = False


class CanBus(ABC):
    """One CAN bus. All methods except `open` return at once.

    `missed`: number of frames that other nodes missed because they read too slowly, if it is known.
    """

    missed = 0

    @abstractmethod
    async def open(self) -> None:
        """Open the bus, also after it was lost; raises BusDown."""

    @abstractmethod
    def send(self, frame: Frame, *, urgent: bool = False) -> bool:
        """Pass a frame to the bus; return False if there is no room now. Raises BusDown when the bus is lost.

        An urgent frame overtakes ordinary frames in our queue, if the bus supports that.
        """

    def flood(self, frame: Frame, t_ns: int) -> None:
        """Put a frame of a foreign node on the bus, at `t_ns` (CLOCK_MONOTONIC) if the bus can choose the time."""
        self.send(frame)

    @abstractmethod
    def take(self) -> list[TimedFrame]:
        """Return the frames on the bus since the last call, without our ordinary frames; raises BusDown."""

    def discard(self) -> None:
        """Discard our ordinary frames that have not begun, if the bus supports that."""
        return

    @abstractmethod
    async def close(self) -> None:
        """Close the bus; may be called at any time."""

    @property
    @abstractmethod
    def address(self) -> str:
        """Address at which other nodes find the bus."""

    @property
    def waiting(self) -> int:
        """Number of our ordinary frames in the queue that have not begun, if it is known."""
        return 0

    @property
    def is_busy(self) -> bool:
        """True while frames are on the bus or wait for it, as far as that is known."""
        return self.waiting > 0

    def serve(self, attend: Callable[[], None]) -> None:
        """Receive the function to call when another node has sent a frame, before or after it can be taken."""
        return

    @property
    def counts(self) -> Mapping[str, int]:
        """Counts of clients of the bus by name, for the summary."""
        return {}

    @property
    def has_listeners(self) -> bool:
        """False when it is certain that no other node is on the bus."""
        return True


_READ_TIMEOUT_S = 0.2
_CONNECT_TIMEOUT_S = 3.0
_OLDEST_STAMP_S = 1.0  # an adapter's time stamp further from now belongs to another clock; the kernel's own never does
_MOST_UNREAD = 100_000
_IFF_UP = 1
_BUS_OFF = 0x40  # linux/can/error.h
_FULL = (errno.ENOBUFS, errno.EAGAIN)
_CAN_ERRORS = (
    can.CanError,
    OSError,
    ImportError,
    NotImplementedError,
    NameError,
    AttributeError,
    ValueError,
    TypeError,
)
"""Errors that interfaces of python-can raise when the bus, its driver or its library is missing."""


def to_message(frame: Frame) -> can.Message:
    """Return a frame as a message of python-can."""
    return can.Message(
        arbitration_id=frame.identifier,
        data=frame.data,
        is_extended_id=frame.extended,
        is_fd=frame.fd,
        bitrate_switch=frame.brs,
        is_error_frame=frame.error,
    )


def from_message(message: can.Message) -> Frame | None:
    """Return a message of python-can as a frame; None for a remote frame, which carries no data."""
    if message.is_remote_frame:
        return None
    return Frame(
        message.arbitration_id,
        bytes(message.data),
        extended=message.is_extended_id and not message.is_error_frame,
        fd=message.is_fd,
        brs=message.is_fd and message.bitrate_switch,
        error=message.is_error_frame,
    )


class PythonCanBus(CanBus):
    """CAN bus of python-can, given by interface and channel."""

    def __init__(self, parameters: CanLink, channel: str) -> None:
        self._parameters = parameters
        self._channel = channel
        self._bus: can.BusABC | None = None
        self._reader: threading.Thread | None = None
        self._unread: deque[TimedFrame] = deque(maxlen=_MOST_UNREAD)
        self._failure: str | None = None
        self._closing = threading.Event()
        self._arrived = asyncio.Event()
        self._notified = False  # True while `_arrived` is set or about to be
        self._attend: Callable[[], None] = lambda: None
        # udp_multicast returns our own frames to us (python-can 4.6): this signature identifies them.
        self._signature = f"evstim-{os.getpid()}-{id(self)}"

    @property
    def address(self) -> str:
        """Interface and channel."""
        return f"{self._parameters.interface}:{self._channel}"

    async def open(self) -> None:
        """Open the bus; runs in a thread, because some interfaces wait for their adapter."""
        await self.close()
        try:
            self._bus = await asyncio.get_running_loop().run_in_executor(None, self._open)
        except _CAN_ERRORS as error:
            raise BusDown(self._advice(error)) from error
        self._failure = None
        self._loop = asyncio.get_running_loop()
        self._closing.clear()
        self._reader = threading.Thread(target=self._read, args=(self._bus,), name=self.address, daemon=True)
        self._reader.start()

    def _open(self) -> can.BusABC:
        p = self._parameters
        flags = Path("/sys/class/net", self._channel, "flags")
        if p.interface == "socketcan" and flags.exists() and not int(flags.read_text(), 16) & _IFF_UP:
            raise OSError(errno.ENETDOWN, "Network is down")
        settings: dict[str, Any] = {"bitrate": p.bitrate}
        if p.interface == "socketcand":
            # The interface logs a warning for every frame that TCP delivers in two pieces, and the traceback of an
            # error that it also raises.
            logging.getLogger("can.interfaces.socketcand").setLevel(logging.CRITICAL)
            # The interface retries for ten seconds if no server listens.
            socket.create_connection((p.host, p.port), _CONNECT_TIMEOUT_S).close()
            settings = {"host": p.host, "port": p.port}
        elif p.fd and p.interface != "virtual":
            settings |= {"fd": True, "data_bitrate": p.data_bitrate}
        # A python-can configuration file on this machine must not change the rig's settings.
        return can.Bus(channel=self._channel, interface=p.interface, ignore_config=True, **(settings | p.options))

    def send(self, frame: Frame, *, urgent: bool = False) -> bool:
        """Pass a frame, stamped now, to the bus; False without room. The driver decides if an urgent one overtakes."""
        bus, message = self._living(), to_message(frame)
        if self._parameters.interface == "udp_multicast":
            message.channel = self._signature
        try:
            bus.send(message)
        except can.CanOperationError as error:
            if error.error_code in _FULL or "buffer full" in str(error).lower():
                return False
            raise self._lost(error) from error
        except OSError as error:
            if error.errno in _FULL:
                return False
            raise self._lost(error) from error
        if urgent:
            self._unread.append(TimedFrame(frame, time.monotonic_ns(), is_ours=True))
        return True

    def take(self) -> list[TimedFrame]:
        """Return the frames since the last call; BusDown is raised after those received before the bus was lost."""
        if not self._unread:
            self._living()
        self._notified = False  # first: the next frame may arrive while the others are taken
        frames = []
        while self._unread:
            frames.append(self._unread.popleft())
        return frames

    def serve(self, attend: Callable[[], None]) -> None:
        """Receive the function to call when another node has sent a frame."""
        self._attend = attend

    async def wait(self, timeout_s: float) -> None:
        """Return when a frame has arrived since the last `wait`, or after `timeout_s`."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self._arrived.wait(), timeout_s)
        self._arrived.clear()
        self._notified = False

    async def close(self) -> None:
        """Close the bus."""
        self._closing.set()
        bus, self._bus = self._bus, None
        reader, self._reader = self._reader, None
        if reader is not None:
            await asyncio.get_running_loop().run_in_executor(None, reader.join, 2 * _READ_TIMEOUT_S)
        if bus is not None:
            bus.shutdown()

    def _living(self) -> can.BusABC:
        if self._failure is not None:
            raise BusDown(self._failure)
        if self._bus is None:
            raise BusDown(f"{self.address} is not open")
        return self._bus

    def _lost(self, error: Exception) -> BusDown:
        failure = self._advice(error)
        if self._parameters.interface != "socketcan":  # its reader sees the end itself, after all frames sent before
            self._failure = failure
        return BusDown(failure)

    def _read(self, bus: can.BusABC) -> None:
        """Read until the bus is closed or lost; runs in the reader thread."""
        # The socketcand client of python-can does not notice that its server closed: it reads empty data for ever.
        end: socket.socket | None = getattr(bus, "_SocketCanDaemonBus__socket", None)
        while not self._closing.is_set():
            try:
                message = bus.recv(_READ_TIMEOUT_S)
            except _CAN_ERRORS as error:
                if not self._closing.is_set():
                    self._failure = self._advice(error)
                    self._notify()
                return
            if message is not None:
                self._store(message)
                self._notify()
            elif end is not None and _has_ended(end):
                self._failure = f"CAN bus {self.address}: its server closed the connection"
                self._notify()
                return

    def _notify(self) -> None:
        """Wake the waiting task, at most once until it has read all frames."""
        if not self._notified and not self._closing.is_set():
            self._notified = True
            self._loop.call_soon_threadsafe(self._received)

    def _received(self) -> None:
        self._arrived.set()
        self._attend()

    def _store(self, message: can.Message) -> None:
        frame = from_message(message)
        if frame is None or message.channel == self._signature:
            return
        if frame.error and frame.identifier & _BUS_OFF:
            self._failure = (
                f"{self.address} is bus-off: too many errors on the wire (bit rate, termination, no other node?); "
                f"sudo ip link set {self._channel} type can restart-ms 100 lets it come back by itself"
            )
            return
        now_ns = time.monotonic_ns()
        stamp_ns = round(message.timestamp * 1e9) - wall_less_monotonic_ns()
        is_recent = self._parameters.interface == "socketcan" or now_ns - stamp_ns <= _OLDEST_STAMP_S * 1e9
        self._unread.append(TimedFrame(frame, stamp_ns if stamp_ns <= now_ns and is_recent else now_ns))

    def _advice(self, error: Exception) -> str:
        """Return the message of an error with the remedy."""
        p = self._parameters
        code = getattr(error, "error_code", None) or getattr(error, "errno", None)
        kind = "" if self._channel.startswith("vcan") else f" type can bitrate {p.bitrate}"
        cure = _CURES.get(code, "").format(p=p, channel=self._channel, kind=kind) or _cure_by_text(p, str(error))
        message = str(error).partition("Traceback")[0].rstrip()  # python-can's socketcand appends a traceback
        return f"CAN bus {self.address}: {message}; {cure}"


def _has_ended(connection: socket.socket) -> bool:
    """Return True if the other side of a TCP connection has closed it and all data are read."""
    try:
        return not connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False
    except OSError:
        return True


_NO_CAN = 'this kernel has no CAN: sudo modprobe can_raw; or use interface = "served", which needs nothing'
_NOT_ALLOWED = "not allowed: an adapter's port belongs to a group (sudo usermod -aG dialout $USER, log in again)"
_NO_ADAPTER = "is the adapter plugged in?"
_NO_SERVER = "nothing serves a bus on {p.host} port {p.port}: start that first"
_CURES: dict[int | None, str] = {
    errno.EAFNOSUPPORT: _NO_CAN,
    errno.EPROTONOSUPPORT: _NO_CAN,
    errno.ENETDOWN: "it is down: sudo ip link set {channel} up{kind}",
    errno.ENODEV: "there is no such interface (ip -br link shows what there is); a virtual one: sudo modprobe vcan; "
    "sudo ip link add dev {channel} type vcan; sudo ip link set {channel} up",
    errno.ENXIO: "the interface has gone; evstim tries again every second",
    errno.EACCES: _NOT_ALLOWED,
    errno.EPERM: _NOT_ALLOWED,
    errno.ENOENT: _NO_ADAPTER,
    errno.ECONNREFUSED: _NO_SERVER,
}


def _cure_by_text(p: CanLink, text: str) -> str:
    """Return the remedy for interfaces that give the cause in their message only."""
    driver = f"the vendor's driver for {p.interface} is not installed"
    cures = {
        "No module named": f"pip install 'python-can[{p.interface.replace('_', '-')}]'",
        "' not supported": f"known are {', '.join(sorted(can.VALID_INTERFACES))} and served",
        "Permission denied": _NOT_ALLOWED,
        "No such file": _NO_ADAPTER,
        "library": driver,
        "is not defined": driver,
        "connect": _NO_SERVER.format(p=p),
    }
    return next((cure for sign, cure in cures.items() if sign in text), "see the documentation of python-can")
