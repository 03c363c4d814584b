"""The files of a mounted FunctionFS: ep0, and ep1, ep2 ... in the order of the endpoint descriptors.

Endpoints are opened O_NONBLOCK: then a call fails with EAGAIN while no host has chosen the configuration, where it
would otherwise wait and send old data to the next host; while there is one it blocks all the same. Events are waited
for by poll, because a blocked read of ep0 holds a lock that unbinding the controller needs.

Calls go to libc: `os.write` would start again by itself after a signal.

    ep0, IN request     write: data stage            read: stall
    ep0, OUT request    read: data stage, or acknowledge    write: stall
    endpoint            a call in the wrong direction halts it
    ioctl 0x82          the endpoint's descriptor in use (9 bytes), linux/usb/functionfs.h

What the kernel's FunctionFS is to the camera's side of it: one control pipe and one pipe for each endpoint.

`transports.usb.functionfs.files` has the real ones. Calls block; each pipe is used by a thread of its own.

Which endpoint numbers a USB device controller gives, and how a camera gets the ones that its drivers know.

Drivers of cameras name endpoints by number; the controller chooses the numbers itself, in the order in which endpoints
are declared. Most count 1, 2, 3 ... in each direction. Where a number comes too early, an unused endpoint takes it:

    dummy_udc   IN 1 6 11 2    DAVIS346: 0x81, unused 0x86, unused 0x8B, 0x82
    others      IN 1 2         DAVIS346: 0x81, 0x82
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
import select
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from firmware_protocol.usb.descriptors import Endpoint, Interface, TransferType
from firmware_protocol.usb.functionfs import EVENT_BYTES, Event

__all__ = [
    "WAKE_SIGNAL",
    "ControlFile",
    "ControlPipe",
    "DataPipe",
    "EndpointFile",
    "Function",
    "FunctionFiles",
    "with_spares",
]


WAKE_SIGNAL = signal.SIGUSR2
"""Ends a blocked call of an endpoint; the process needs a handler for it, which may do nothing."""

_DESCRIPTOR_BYTES = 9
_ENDPOINT_DESCRIPTOR = 2 << 30 | _DESCRIPTOR_BYTES << 16 | ord("g") << 8 | 130  # _IOR('g', 130, 9 bytes)
_IN = 0x80
_NO_EVENT = (errno.EAGAIN, errno.EINTR, errno.EIDRM)  # EIDRM: the host gave up the last request

_libc = ctypes.CDLL(None, use_errno=True)
_libc.write.argtypes = (ctypes.c_int, ctypes.c_char_p, ctypes.c_size_t)
_libc.read.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_size_t)
_libc.write.restype = _libc.read.restype = ctypes.c_ssize_t


def _write(fd: int, data: bytes) -> int:
    return _checked(_libc.write(fd, data, len(data)))


def _read(fd: int, most_bytes: int) -> bytes:
    buffer = ctypes.create_string_buffer(most_bytes)
    count = _checked(_libc.read(fd, buffer, most_bytes))
    return buffer.raw[:count]


def _checked(count: int) -> int:
    if count < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return count


@contextlib.contextmanager
def _told_by(number: int) -> Iterator[None]:
    """Expect the error that tells of a halt which was done."""
    try:
        yield
    except OSError as error:
        if error.errno != number:
            raise


class ControlFile:
    """See `ControlPipe`; `fd` is ep0, opened O_NONBLOCK."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._wake_out, self._wake_in = os.pipe()

    def next_event(self) -> Event | None:
        """See `ControlPipe`."""
        asked = select.poll()
        asked.register(self._fd, select.POLLIN)
        asked.register(self._wake_out, select.POLLIN)
        while True:
            ready = dict(asked.poll())
            if self._wake_out in ready:
                return None
            try:
                return Event.parse(_read(self._fd, EVENT_BYTES))
            except OSError as error:
                if error.errno not in _NO_EVENT:
                    raise

    def wake(self) -> None:
        """See `ControlPipe`."""
        os.write(self._wake_in, b"!")

    def send(self, data: bytes) -> None:
        """See `ControlPipe`."""
        _write(self._fd, data)

    def receive(self, length: int) -> bytes:
        """See `ControlPipe`."""
        return _read(self._fd, length)

    def refuse(self, *, is_in: bool) -> None:
        """See `ControlPipe`."""
        with _told_by(errno.EL2HLT):
            if is_in:
                _read(self._fd, 0)
            else:
                _write(self._fd, b"")

    def close(self) -> None:
        """Close ep0: the kernel takes the gadget from its controller."""
        for fd in (self._fd, self._wake_out, self._wake_in):
            os.close(fd)


class EndpointFile:
    """See `DataPipe`.

    Parameters
    ----------
    fd
        The file, opened O_RDWR and O_NONBLOCK.
    address
        The camera's own address of the endpoint, with the direction bit.
    """

    def __init__(self, fd: int, address: int) -> None:
        self._fd = fd
        self.address = address
        self._thread: int | None = None  # which is in a call

    @property
    def number(self) -> int:
        """See `DataPipe`."""
        return self.address & ~_IN

    @property
    def is_in(self) -> bool:
        """See `DataPipe`."""
        return bool(self.address & _IN)

    def packet_bytes(self) -> int:
        """See `DataPipe`."""
        return int.from_bytes(self._descriptor()[4:6], "little")

    def given_address(self) -> int:
        """Address that the controller gave, with the direction bit; raises OSError while there is no host."""
        return self._descriptor()[2]

    def write(self, data: bytes) -> None:
        """See `DataPipe`."""
        with self._blocking():
            _write(self._fd, data)

    def read(self, most_bytes: int) -> bytes:
        """See `DataPipe`."""
        with self._blocking():
            return _read(self._fd, most_bytes)

    def interrupt(self) -> None:
        """See `DataPipe`."""
        if (thread := self._thread) is not None:
            signal.pthread_kill(thread, WAKE_SIGNAL)

    def halt(self) -> None:
        """See `DataPipe`."""
        with _told_by(errno.EBADMSG):
            if self.is_in:
                _read(self._fd, 0)
            else:
                _write(self._fd, b"")

    def close(self) -> None:
        """Close the file."""
        os.close(self._fd)

    @contextlib.contextmanager
    def _blocking(self) -> Iterator[None]:
        self._thread = threading.get_ident()
        try:
            yield
        finally:
            self._thread = None

    def _descriptor(self) -> bytes:
        return fcntl.ioctl(self._fd, _ENDPOINT_DESCRIPTOR, bytes(_DESCRIPTOR_BYTES))


class FunctionFiles:
    """The files of a mounted FunctionFS, ready for its controller.

    Parameters
    ----------
    mount
        Where it is mounted.
    blocks
        Descriptors and strings, see `firmware_protocol.usb.functionfs`.
    addresses
        The camera's own addresses of endpoints, with the direction bit, by the place of their descriptors, from 1.

    Raises
    ------
    OSError
        A file cannot be opened, or the kernel does not take the descriptors.
    """

    def __init__(self, mount: Path, blocks: Sequence[bytes], addresses: Mapping[int, int]) -> None:
        with contextlib.ExitStack() as on_failure:
            fd = os.open(mount / "ep0", os.O_RDWR | os.O_NONBLOCK)
            self.control = ControlFile(fd)
            on_failure.callback(self.control.close)
            for block in blocks:
                _write(fd, block)
            self.pipes: list[EndpointFile] = []
            for place, address in addresses.items():
                self.pipes.append(EndpointFile(os.open(mount / f"ep{place}", os.O_RDWR | os.O_NONBLOCK), address))
                on_failure.callback(self.pipes[-1].close)
            on_failure.pop_all()

    @property
    def given(self) -> dict[int, int]:
        """Addresses that the controller gave, by the camera's own; raises OSError while there is no host."""
        return {pipe.address: pipe.given_address() for pipe in self.pipes}

    def close(self) -> None:
        """Close them all."""
        for pipe in self.pipes:
            pipe.close()
        self.control.close()


class ControlPipe(Protocol):
    """Endpoint 0."""

    def next_event(self) -> Event | None:
        """Wait for the next event; None after `wake`."""

    def wake(self) -> None:
        """End the waiting of `next_event`, from another thread."""

    def send(self, data: bytes) -> None:
        """Do the data stage of an IN request; raises OSError when the host gave up."""

    def receive(self, length: int) -> bytes:
        """Do the data stage of an OUT request, or acknowledge one without; raises OSError when the host gave up."""

    def refuse(self, *, is_in: bool) -> None:
        """Stall the request, before its data stage; raises OSError when the host gave up."""


class DataPipe(Protocol):
    """One endpoint but 0."""

    @property
    def number(self) -> int:
        """Number of the camera's endpoint, without the direction bit."""

    @property
    def is_in(self) -> bool:
        """True where data go to the host."""

    def packet_bytes(self) -> int:
        """Length of a full packet at the speed of the moment."""

    def write(self, data: bytes) -> None:
        """Give data to the host; returns when it has them. Raises OSError."""

    def read(self, most_bytes: int) -> bytes:
        """Take one transfer of the host. Raises OSError."""

    def halt(self) -> None:
        """Let the host's transfers fail until it clears the halt. Raises OSError."""

    def interrupt(self) -> None:
        """End the call that blocks now in another thread, with InterruptedError; one that begins later goes on."""


class Function(Protocol):
    """An interface at a USB device controller."""

    @property
    def control(self) -> ControlPipe:
        """Endpoint 0."""

    @property
    def pipes(self) -> Sequence[DataPipe]:
        """The other endpoints that the camera uses."""


_IN_ORDER = tuple(range(1, 16))
_BY_DRIVER = {"dummy_udc": ((1, 6, 11, 2), (2, 7, 12, 1))}  # bulk endpoints of dummy_hcd.c: IN, OUT


def with_spares(interface: Interface, controller: str) -> Interface:
    """Return an interface whose endpoints get their addresses at a controller, named as in /sys/class/udc.

    Raises ValueError where the controller cannot give one of them.
    """
    in_order, out_order = _BY_DRIVER.get(controller.partition(".")[0], (_IN_ORDER, _IN_ORDER))
    ins = _declared(interface.endpoints, [_IN | number for number in in_order], controller)
    outs = _declared(interface.endpoints, out_order, controller)
    return replace(interface, endpoints=(*ins, *outs))


def _declared(endpoints: Sequence[Endpoint], given: Sequence[int], controller: str) -> Iterator[Endpoint]:
    """Yield the endpoints of one direction in the order of the addresses that will be given, and unused ones."""
    wanted = {one.address: one for one in endpoints if one.address & _IN == given[0] & _IN}
    if missing := wanted.keys() - set(given):
        told = ", ".join(f"0x{address:02X}" for address in sorted(missing))
        raise ValueError(
            f"the USB device controller {controller} has no endpoint {told}, which drivers of this camera use"
        )
    packet = max(one.max_packet for one in endpoints)
    for address in given:
        if not wanted:
            return
        yield wanted.pop(address) if address in wanted else Endpoint(address, TransferType.BULK, packet)
