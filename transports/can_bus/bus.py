"""What a CAN bus is to a link, whoever carries it.

Any bus that python-can knows, without waiting for it: a thread of its own reads.
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
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can

from firmware_protocol.can_frames.frame import Frame
from transports.can_bus.kind import CanLink

__all__ = ["BusDown", "CanBus", "Heard", "PythonCanBus", "from_message", "to_message"]


class BusDown(OSError):
    """A bus cannot be had, or is gone; the message says what to do."""


@dataclass(frozen=True)
class Heard:
    """A frame, and when it was on the bus (CLOCK_MONOTONIC, ns); `own` for an urgent one of ours that has left."""

    frame: Frame
    t_ns: int
    own: bool = False


class CanBus(ABC):
    """One bus. Its methods return at once, except `open`.

    Attributes
    ----------
    missed
        Frames that others were too slow to take, where that is known.
    """

    missed = 0

    @abstractmethod
    async def open(self) -> None:
        """Open it, again after it was lost; raises BusDown."""

    @abstractmethod
    def send(self, frame: Frame, *, urgent: bool = False) -> bool:
        """Hand over a frame; False: there is no room now. Raises BusDown when the bus is gone.

        An urgent frame passes ordinary ones that wait on our side, where the bus can do that.
        """

    def flood(self, frame: Frame, t_ns: int) -> None:
        """Put a frame of a strange node on the bus, at `t_ns` (CLOCK_MONOTONIC) where that can be chosen."""
        self.send(frame)

    @abstractmethod
    def take(self) -> list[Heard]:
        """Return what was on the bus since the last call, but for our ordinary frames; raises BusDown."""

    def discard(self) -> None:
        """Forget our ordinary frames that were handed over and have not begun, where that can be done."""
        return

    @abstractmethod
    async def close(self) -> None:
        """Let go of it; may be called at any time."""

    @property
    @abstractmethod
    def address(self) -> str:
        """Where others find it."""

    @property
    def waiting(self) -> int:
        """Ordinary frames that were handed over and have not begun, where that is known."""
        return 0

    @property
    def counts(self) -> Mapping[str, int]:
        """What happened to those who joined the bus, by name, for the summary."""
        return {}

    @property
    def heard(self) -> bool:
        """False when it is certain that no other node is on the bus."""
        return True


_READ_TIMEOUT_S = 0.2
_CONNECT_TIMEOUT_S = 3.0
_OLDEST_STAMP_S = 1.0  # a stamp of the adapter that is further from now belongs to another clock
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
"""What interfaces of python-can raise when their bus, their driver or their library is not there."""


def to_message(frame: Frame) -> can.Message:
    """Return a frame as python-can writes it."""
    return can.Message(
        arbitration_id=frame.identifier,
        data=frame.data,
        is_extended_id=frame.extended,
        is_fd=frame.fd,
        bitrate_switch=frame.brs,
        is_error_frame=frame.error,
    )


def from_message(message: can.Message) -> Frame | None:
    """Return a message of python-can as a frame; None for a remote frame, which asks and tells nothing."""
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
    """A bus by its interface and channel."""

    def __init__(self, parameters: CanLink, channel: str) -> None:
        self._parameters = parameters
        self._channel = channel
        self._bus: can.BusABC | None = None
        self._reader: threading.Thread | None = None
        self._unread: deque[Heard] = deque(maxlen=_MOST_UNREAD)
        self._failure: str | None = None
        self._closing = threading.Event()
        self._arrived = asyncio.Event()
        self._told = False  # whether `_arrived` is set or about to be
        # udp_multicast gives our own frames back to us (python-can 4.6): they are told by this.
        self._signature = f"evstim-{os.getpid()}-{id(self)}"

    @property
    def address(self) -> str:
        """Interface and channel."""
        return f"{self._parameters.interface}:{self._channel}"

    async def open(self) -> None:
        """See `CanBus.open`; in a thread, since interfaces may wait for their adapter."""
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
        if p.interface == "socketcan" and not _is_up(self._channel):
            raise OSError(errno.ENETDOWN, "Network is down")
        settings: dict[str, Any] = {"bitrate": p.bitrate}
        if p.interface == "socketcand":
            # It warns of every frame that TCP delivers in two pieces.
            logging.getLogger("can.interfaces.socketcand").setLevel(logging.ERROR)
            # It tries for ten seconds where nothing listens.
            socket.create_connection((p.host, p.port), _CONNECT_TIMEOUT_S).close()
            settings = {"host": p.host, "port": p.port}
        elif p.fd and p.interface != "virtual":
            settings |= {"fd": True, "data_bitrate": p.data_bitrate}
        # A configuration file of python-can on this machine must not change what the rig says.
        return can.Bus(channel=self._channel, interface=p.interface, ignore_config=True, **(settings | p.options))

    def send(self, frame: Frame, *, urgent: bool = False) -> bool:
        """See `CanBus.send`. Whether an urgent frame passes others is up to the driver; it is said to leave at once."""
        bus = self._living()
        try:
            bus.send(self._message(frame))
        except can.CanOperationError as error:
            if error.error_code in _FULL or "buffer full" in str(error).lower():
                return False
            raise self._lost(error) from error
        except OSError as error:
            if error.errno in _FULL:
                return False
            raise self._lost(error) from error
        if urgent:
            self._unread.append(Heard(frame, time.monotonic_ns(), own=True))
        return True

    def take(self) -> list[Heard]:
        """See `CanBus.take`; what came before the bus was lost is told before that."""
        if not self._unread:
            self._living()
        heard = []
        while self._unread:
            heard.append(self._unread.popleft())
        return heard

    async def wait(self, timeout_s: float) -> None:
        """Return when something has come since the last `wait`, or after `timeout_s`."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self._arrived.wait(), timeout_s)
        self._arrived.clear()
        self._told = False

    async def close(self) -> None:
        """See `CanBus.close`."""
        self._closing.set()
        bus, self._bus = self._bus, None
        reader, self._reader = self._reader, None
        if reader is not None:
            await asyncio.get_running_loop().run_in_executor(None, reader.join, 2 * _READ_TIMEOUT_S)
        if bus is not None:
            bus.shutdown()

    def _message(self, frame: Frame) -> can.Message:
        message = to_message(frame)
        if self._parameters.interface == "udp_multicast":
            message.channel = self._signature
        return message

    def _living(self) -> can.BusABC:
        if self._failure is not None:
            raise BusDown(self._failure)
        if self._bus is None:
            raise BusDown(f"{self.address} is not open")
        return self._bus

    def _lost(self, error: Exception) -> BusDown:
        failure = self._advice(error)
        if self._parameters.interface != "socketcand":  # its reader sees the end itself, after all that was sent before
            self._failure = failure
        return BusDown(failure)

    def _read(self, bus: can.BusABC) -> None:
        """Read until the bus is closed or gone: the reader's thread."""
        # python-can's client of socketcand does not see that its server has gone: it reads nothing, again and again.
        end: socket.socket | None = getattr(bus, "_SocketCanDaemonBus__socket", None)
        while not self._closing.is_set():
            try:
                message = bus.recv(_READ_TIMEOUT_S)
            except _CAN_ERRORS as error:
                if not self._closing.is_set():
                    self._failure = self._advice(error)
                    self._tell()
                return
            if message is not None:
                self._keep(message)
                self._tell()
            elif end is not None and _has_ended(end):
                self._failure = f"CAN bus {self.address}: its server closed the connection"
                self._tell()
                return

    def _tell(self) -> None:
        """Wake who waits, at most once for all that has come."""
        if not self._told and not self._closing.is_set():
            self._told = True
            self._loop.call_soon_threadsafe(self._arrived.set)

    def _keep(self, message: can.Message) -> None:
        frame = from_message(message)
        if frame is None or message.channel == self._signature:
            return
        if frame.error and frame.identifier & _BUS_OFF:
            self._failure = (
                f"{self.address} is bus-off: too many errors on the wire (bit rate, termination, no other node?); "
                f"sudo ip link set {self._channel} type can restart-ms 100 lets it come back by itself"
            )
            return
        age_s = time.time() - message.timestamp
        known = 0 <= age_s <= _OLDEST_STAMP_S
        self._unread.append(Heard(frame, time.monotonic_ns() - (round(age_s * 1e9) if known else 0)))

    def _advice(self, error: Exception) -> str:
        return f"CAN bus {self.address}: {error}; {_cure(self._parameters, self._channel, error)}"


def _has_ended(connection: socket.socket) -> bool:
    """Say whether the other side of a TCP connection has closed it and all is read."""
    try:
        return not connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False
    except OSError:
        return True


def _is_up(channel: str) -> bool:
    """Say whether a network interface is up; True where that cannot be known."""
    flags = Path("/sys/class/net", channel, "flags")
    return not flags.exists() or bool(int(flags.read_text(), 16) & _IFF_UP)


def _cure(p: CanLink, channel: str, error: Exception) -> str:
    """Say what to do about a bus that cannot be had."""
    code = getattr(error, "error_code", None) or getattr(error, "errno", None)
    kind = "" if channel.startswith("vcan") else f" type can bitrate {p.bitrate}"
    return _CURES.get(code, "").format(p=p, channel=channel, kind=kind) or _cure_by_text(p, str(error))


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
    errno.ENXIO: "the interface has gone; it is tried again every second",
    errno.EACCES: _NOT_ALLOWED,
    errno.EPERM: _NOT_ALLOWED,
    errno.ENOENT: _NO_ADAPTER,
    errno.ECONNREFUSED: _NO_SERVER,
}


def _cure_by_text(p: CanLink, text: str) -> str:
    """Say it for interfaces that put the cause into their message only."""
    driver = f"the maker's driver for {p.interface} is not installed"
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
