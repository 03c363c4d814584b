"""Files of a mounted FunctionFS: ep0, and ep1, ep2 ... in the order of the endpoint descriptors.

Endpoints are opened O_NONBLOCK. Then a call fails with EAGAIN while no host has selected the configuration; otherwise
it would wait and send old data to the next host. While there is a host the call still blocks. Events are awaited by
poll, because a blocked read of ep0 holds a lock that is needed to unbind the controller.

Calls go to libc: `os.write` would restart by itself after a signal.

    ep0, IN request     write: data stage            read: stall
    ep0, OUT request    read: data stage, or acknowledge    write: stall
    endpoint            a call in the wrong direction halts it
    ioctl 0x82          the endpoint's descriptor in use (9 bytes), linux/usb/functionfs.h

Calls of a file block, so each is used by its own thread.

`with_spares` assigns endpoint numbers. Drivers of cameras name endpoints by number, but the USB device controller
assigns the numbers in the order in which endpoints are declared. Most controllers count 1, 2, 3 ... in each direction.
If a number would be assigned too early, an unused endpoint takes it:

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

from firmware_protocol.usb.descriptors import Endpoint, Interface, TransferType
from firmware_protocol.usb.functionfs import EVENT_BYTES, Event

WAKE_SIGNAL = signal.SIGUSR2
"""Signal that ends a blocked call of an endpoint; the process needs a handler for it, which may be empty."""

_DESCRIPTOR_BYTES = 9
_ENDPOINT_DESCRIPTOR = 2 << 30 | _DESCRIPTOR_BYTES << 16 | ord("g") << 8 | 130  # _IOR('g', 130, 9 bytes)
_IN = 0x80
_NO_EVENT = (errno.EAGAIN, errno.EINTR, errno.EIDRM)  # EIDRM: the host aborted the last request

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


def _halt(fd: int, *, is_in: bool, number: int) -> None:
    """Transfer in the wrong direction, which the kernel executes as a halt and reports as the error `number`."""
    try:
        if is_in:
            _read(fd, 0)
        else:
            _write(fd, b"")
    except OSError as error:
        if error.errno != number:
            raise


class ControlFile:
    """Endpoint 0; `fd` is ep0, opened O_NONBLOCK. Data stages raise OSError when the host aborted the request."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._wake_out, self._wake_in = os.pipe()

    def next_event(self) -> Event | None:
        """Wait for the next event; None after `wake`."""
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        poll.register(self._wake_out, select.POLLIN)
        while True:
            ready = dict(poll.poll())
            if self._wake_out in ready:
                return None
            try:
                return Event.parse(_read(self._fd, EVENT_BYTES))
            except OSError as error:
                if error.errno not in _NO_EVENT:
                    raise

    def wake(self) -> None:
        """End the wait of another thread in `next_event`."""
        os.write(self._wake_in, b"!")

    def send(self, data: bytes) -> None:
        """Send the data stage of an IN request."""
        _write(self._fd, data)

    def receive(self, length: int) -> bytes:
        """Receive the data stage of an OUT request, or acknowledge one without."""
        return _read(self._fd, length)

    def refuse(self, *, is_in: bool) -> None:
        """Halt the request."""
        _halt(self._fd, is_in=is_in, number=errno.EL2HLT)

    def close(self) -> None:
        """Close ep0: the kernel disconnects the gadget from its controller."""
        for fd in (self._fd, self._wake_out, self._wake_in):
            os.close(fd)


class EndpointFile:
    """Endpoint other than 0, for one thread's transfers; they raise OSError, InterruptedError after `interrupt`.

    `fd`: the file, opened O_RDWR and O_NONBLOCK; `address`: the camera's own of the endpoint, with the direction bit.
    """

    def __init__(self, fd: int, address: int) -> None:
        self._fd = fd
        self.address = address
        self._thread: int | None = None  # id of the thread in a call

    @property
    def number(self) -> int:
        """Number of the endpoint, without its direction."""
        return self.address & ~_IN

    @property
    def is_in(self) -> bool:
        """True if data go to the host."""
        return bool(self.address & _IN)

    def packet_bytes(self) -> int:
        """Size of a packet at the present speed; raises OSError while there is no host."""
        return int.from_bytes(self._descriptor()[4:6], "little")

    def given_address(self) -> int:
        """Address that the controller assigned, with the direction bit; raises OSError while there is no host."""
        return self._descriptor()[2]

    def write(self, data: bytes) -> None:
        """Send data; blocks until the host has read them, or `interrupt`."""
        with self._blocking():
            _write(self._fd, data)

    def read(self, most_bytes: int) -> bytes:
        """Receive at most `most_bytes`; blocks until the host has sent them, or `interrupt`."""
        with self._blocking():
            return _read(self._fd, most_bytes)

    def interrupt(self) -> None:
        """End the call in which another thread is blocked; a later call is not affected."""
        if (thread := self._thread) is not None:
            signal.pthread_kill(thread, WAKE_SIGNAL)

    def halt(self) -> None:
        """Halt the endpoint until the host clears it."""
        _halt(self._fd, is_in=self.is_in, number=errno.EBADMSG)

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
    """Files of a mounted FunctionFS, ready for its controller; raises OSError, also if the kernel refuses them.

    Parameters
    ----------
    mount : folder in which it is mounted.
    blocks : descriptors and strings, see `firmware_protocol.usb.functionfs`.
    addresses
        The camera's own addresses of endpoints, with the direction bit, by the index of their descriptors, from 1.
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
        """Addresses that the controller assigned, by the camera's own; raises OSError while there is no host."""
        return {pipe.address: pipe.given_address() for pipe in self.pipes}

    def close(self) -> None:
        """Close all files."""
        for pipe in self.pipes:
            pipe.close()
        self.control.close()


_IN_ORDER = tuple(range(1, 16))
_BY_DRIVER = {"dummy_udc": ((1, 6, 11, 2), (2, 7, 12, 1))}  # bulk endpoints of dummy_hcd.c: IN, OUT


def with_spares(interface: Interface, controller: str) -> Interface:
    """Return an interface with addresses of a controller in /sys/class/udc; ValueError if an endpoint gets none."""
    in_order, out_order = _BY_DRIVER.get(controller.partition(".")[0], (_IN_ORDER, _IN_ORDER))
    ins = _declared(interface.endpoints, [_IN | number for number in in_order], controller)
    outs = _declared(interface.endpoints, out_order, controller)
    return replace(interface, endpoints=(*ins, *outs))


def _declared(endpoints: Sequence[Endpoint], assigned: Sequence[int], controller: str) -> Iterator[Endpoint]:
    """Yield the endpoints of one direction in the order of the assigned addresses, with unused ones in between."""
    by_address = {endpoint.address: endpoint for endpoint in endpoints if endpoint.address & _IN == assigned[0] & _IN}
    if missing := by_address.keys() - set(assigned):
        numbers = ", ".join(f"0x{address:02X}" for address in sorted(missing))
        raise ValueError(
            f"the USB device controller {controller} has no endpoint {numbers}, which drivers of this camera use"
        )
    packet = max(endpoint.max_packet for endpoint in endpoints)
    for address in assigned:
        if not by_address:
            return
        yield by_address.pop(address) if address in by_address else Endpoint(address, TransferType.BULK, packet)
