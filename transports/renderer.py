"""TCP port for one external renderer, and the memory that its images come in.

    server = RendererServer("127.0.0.1", 5560)
    connection = server.accept(wanted, wait_s=30)      HELLO, CAMERA, READY
    connection.request(t_ns)                           a DRAW into the next slot
    image = connection.receive(timeout_s=5)            its planes are a copy of the slot, which is free again

The pixels come over the socket, or the renderer writes them into memory that both processes share. That memory is a
file without a name in any folder (memfd), which the renderer opens by its path in /proc. Whatever the renderer does to
it, this process goes on: its size is sealed, so that opening it with O_TRUNC is an error in the renderer; and it is
read like a file, never mapped, because a mapped page that has gone is a signal (SIGBUS). Its room is reserved in
advance.

One renderer is served; the port closes when it is accepted. Up to `_GUESTS` peers may send their HELLO at the same
time, so that silent ones keep no renderer out; the oldest makes room for a newer one. A peer that is not allowed, sends
something else or nothing is disconnected. A peer that has sent a HELLO is the renderer, or fails within `_GREETING_S`.
"""

from __future__ import annotations

import fcntl
import math
import os
import socket
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from io import FileIO
from multiprocessing.connection import wait
from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.renderer import (
    ANY_TIME,
    HEADER_OCTETS,
    Camera,
    Draw,
    End,
    Hello,
    Image,
    MessageError,
    Plane,
    Type,
    parse_header,
    planes_of,
    slot_octets,
)
from transports.network import AllowList

_GREETING_S = 2.0
_SEND_S = 5.0
_LOOK_S = 0.25  # the longest time until a limit that came meanwhile is looked at
_GUESTS = 64
_BACKLOG = 128
_REFUSALS = 4


class RendererError(Exception):
    """The renderer cannot be used any longer; the message gives the reason."""


class RendererEnded(RendererError):
    """The renderer has reached the end of its scene, or was waited for when the run was stopped."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """One image: number, time and bound on motion; (height, width) or (height, width, 2) `planes` by name."""

    head: Image
    planes: dict[str, npt.NDArray[Any]]


class RendererServer:
    """TCP port on `host` and `port` (0: any free one) for a renderer at one of `allow`; raises OSError.

    `refusals`: addresses of the last refused peers, with the reasons.
    """

    def __init__(self, host: str, port: int, allow: Sequence[str] = ()) -> None:
        self._allow = AllowList(allow)
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._listener = socket.create_server((host, port), family=family, backlog=_BACKLOG)
        self._listener.setblocking(False)
        self._guests: dict[Any, _Guest] = {}  # by their sockets, the oldest first
        self.refusals: deque[str] = deque(maxlen=_REFUSALS)

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the port."""
        host, port = self._listener.getsockname()[:2]
        return host, port

    def accept(self, camera: Camera, wait_s: float) -> RendererConnection | None:
        """Return the connection of a renderer that draws for the camera `camera`; None where none came in time.

        Slot size and path of `camera` are not used. Afterwards the port is closed. Raises OSError where the shared
        memory has no room.
        """
        until_s = time.monotonic() + wait_s
        try:
            while (now_s := time.monotonic()) < until_s:
                next_s = min([until_s, *(guest.until_s for guest in self._guests.values())])
                ready = wait([self._listener, *self._guests], max(next_s - now_s, 0.0))
                for peer in ready:
                    if peer is not self._listener and (connection := self._greeted(peer, camera)) is not None:
                        return connection
                if self._listener in ready:
                    self._admit()
                for peer in [peer for peer, guest in self._guests.items() if guest.until_s <= now_s]:
                    self._refuse(peer, "nothing more came in time")
            return None
        finally:
            self.close()

    def close(self) -> None:
        """Close the port, and the connections of peers that are not served; a second call does nothing."""
        self._listener.close()
        for peer in list(self._guests):
            self._refuse(peer, "the port was closed")

    def _admit(self) -> None:
        """Accept a peer, in place of the oldest one where there are too many."""
        try:
            peer, (address, *_) = self._listener.accept()
        except OSError:  # it has gone already
            return
        self._guests[peer] = _Guest(_Stream(peer), address)
        if not self._allow.permits(address):
            self._refuse(peer, "its address is not allowed")
        elif len(self._guests) > _GUESTS:
            self._refuse(next(iter(self._guests)), "nothing more came before many others")

    def _greeted(self, peer: Any, camera: Camera) -> RendererConnection | None:
        """Return the connection of a peer; None while its HELLO is not complete, and where it is no renderer."""
        guest = self._guests[peer]
        try:
            hello = guest.hello()
            if hello is None:
                return None
            connection = RendererConnection(guest.stream, hello, camera)
        except (RendererError, MessageError) as error:
            self._refuse(peer, str(error))
            return None
        del self._guests[peer]
        return connection

    def _refuse(self, peer: Any, reason: str) -> None:
        guest = self._guests.pop(peer)
        self.refusals.append(f"{guest.address}: {reason}")
        guest.stream.send_last(End(reason).pack())
        guest.stream.close()


class _Guest:
    """Peer at `address` that has not sent a whole HELLO, which it has to by `until_s`."""

    def __init__(self, stream: _Stream, address: str) -> None:
        self.stream, self.address = stream, address
        self.until_s = time.monotonic() + _GREETING_S
        self._octets = bytearray(HEADER_OCTETS + Hello.OCTETS)
        self._missing = memoryview(self._octets)

    def hello(self) -> Hello | None:
        """Read what has come, and return the HELLO once it is complete; raises RendererError and MessageError."""
        self._missing = self._missing[self.stream.read_some(self._missing, 0.0) :]
        if len(self._missing) > Hello.OCTETS:
            return None
        kind, length = parse_header(bytes(self._octets[:HEADER_OCTETS]))
        _require(kind, length, Type.HELLO, Hello.OCTETS)
        return None if self._missing else Hello.parse(bytes(self._octets[HEADER_OCTETS:][:length]))


def _require(kind: Type, length: int, expected: Type, most_octets: int) -> None:
    """Raise MessageError unless a message is of the type `expected` and of at most `most_octets` octets."""
    if kind is not expected:
        raise MessageError(f"{kind.name} came instead of {expected.name}")
    if length > most_octets:
        raise MessageError(f"{kind.name} has {length} octets, at most {most_octets} are expected")


class _Stream:
    """Messages over a socket, each wait limited."""

    def __init__(self, peer: socket.socket) -> None:
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = peer
        self.end_s = math.inf  # no wait goes beyond it

    def send(self, octets: bytes) -> None:
        try:
            self._socket.settimeout(_SEND_S)
            self._socket.sendall(octets)
        except OSError as error:
            raise RendererError(f"a request could not be sent: {error}") from error

    def send_last(self, octets: bytes) -> None:
        """Send where that is possible at once."""
        with suppress(OSError):  # the peer has gone, or reads nothing
            self._socket.settimeout(0)
            self._socket.send(octets)

    def read_some(self, target: memoryview, until_s: float) -> int:
        """Return the number of octets read into `target`; at least one try is made."""
        while True:
            left_s = min(until_s, self.end_s) - time.monotonic()
            if self.end_s < until_s and left_s <= 0.0:
                raise RendererEnded("the run was stopped")
            try:
                self._socket.settimeout(min(max(left_s, 1e-3), _LOOK_S))
                count = self._socket.recv_into(target)
                break
            except TimeoutError:
                if left_s <= _LOOK_S and self.end_s >= until_s:
                    raise RendererError("nothing more came in time") from None
            except OSError as error:
                raise RendererError(f"the connection broke: {error.strerror or error}") from error
        if not count:
            raise RendererError("it closed the connection in the middle of its scene")
        return count

    def read_into(self, target: memoryview, until_s: float) -> None:
        while target:
            target = target[self.read_some(target, until_s) :]

    def read(self, count: int, until_s: float) -> bytes:
        octets = bytearray(count)
        self.read_into(memoryview(octets), until_s)
        return bytes(octets)

    def expect(self, expected: Type, most_octets: int, until_s: float) -> int:
        """Return the length of the next message, of type `expected`; raises RendererEnded for an END."""
        kind, length = parse_header(self.read(HEADER_OCTETS, until_s))
        if kind is Type.END:
            reason = End.parse(self.read(min(length, 1001), until_s)).reason
            raise RendererError(f"it ended: {reason}") if reason else RendererEnded("its scene has ended")
        _require(kind, length, expected, most_octets)
        return length

    def close(self) -> None:
        self._socket.close()


class RendererConnection:
    """The connection to one renderer; made by `RendererServer.accept`. `hello`: the images that it gives."""

    def __init__(self, stream: _Stream, hello: Hello, camera: Camera) -> None:
        self._stream = stream
        self.hello = hello
        self._size, self._slots = camera.size, camera.slots
        self._planes = planes_of(hello, camera.size)
        self._octets = slot_octets(hello, camera.size)
        self._memory = _sealed_memory(self._slots * self._octets) if hello.shared else None
        path = "" if self._memory is None else f"/proc/{os.getpid()}/fd/{self._memory.fileno()}"
        try:
            stream.send(replace(camera, slot_octets=self._octets, path=path).pack())
            stream.expect(Type.READY, 0, time.monotonic() + _GREETING_S)
        except BaseException:
            self._close_memory()
            raise
        self._requested: deque[Draw] = deque()
        self._count = 0

    @property
    def requested(self) -> int:
        """Number of requests without an image so far."""
        return len(self._requested)

    def request(self, t_ns: int = ANY_TIME, pose: tuple[float, ...] | None = None) -> None:
        """Request the image of `t_ns` from `pose`; at most one a slot before an image comes. Raises RendererError."""
        slot = self._count % self._slots  # images come in the order of requests, so the oldest slot is free
        draw = Draw(self._count, t_ns, slot) if pose is None else Draw(self._count, t_ns, slot, pose)
        self._count += 1
        self._requested.append(draw)
        self._stream.send(draw.pack())

    def receive(self, timeout_s: float) -> Drawn:
        """Return the image of the oldest request; raises RendererError, RendererEnded and MessageError."""
        draw, until_s = self._requested[0], time.monotonic() + timeout_s
        pixels = self._octets if self._memory is None else 0
        try:
            length = self._stream.expect(Type.IMAGE, Image.OCTETS + pixels, until_s)
        except RendererEnded:
            raise
        except RendererError as error:
            raise RendererError(f"{error} (image {draw.number}, within {timeout_s:g} s)") from error
        if length != Image.OCTETS + pixels:
            raise MessageError(f"an image has {length - Image.OCTETS} octets of pixels, not {pixels}")
        head = Image.parse(self._stream.read(Image.OCTETS, until_s))
        if head.number != draw.number or draw.t_ns not in (ANY_TIME, head.t_ns):
            raise MessageError(
                f"image {head.number} of {head.t_ns} ns came for request {draw.number} of {draw.t_ns} ns"
            )
        octets = np.empty(self._octets, np.uint8)
        if self._memory is None:
            self._stream.read_into(octets.data, until_s)
        elif os.preadv(self._memory.fileno(), [octets.data], draw.slot * self._octets) != self._octets:
            raise RendererError("the shared memory could not be read completely")
        self._requested.popleft()
        return Drawn(head, {plane.name: self._view(plane, octets) for plane in self._planes})

    def limit_wait(self, most_s: float) -> None:
        """Limit the time in which all further images may come; for a signal handler."""
        self._stream.end_s = min(self._stream.end_s, time.monotonic() + most_s)

    def close(self, reason: str = "") -> None:
        """End the connection; a second call does nothing."""
        self._stream.send_last(End(reason).pack())
        self._stream.close()
        self._close_memory()

    def _close_memory(self) -> None:
        if self._memory is not None:
            self._memory.close()

    def _view(self, plane: Plane, octets: npt.NDArray[np.uint8]) -> npt.NDArray[Any]:
        width, height = self._size
        shape = (height, width) if plane.channels == 1 else (height, width, plane.channels)
        return np.frombuffer(octets, plane.dtype, math.prod(shape), plane.offset).reshape(shape)


def _sealed_memory(octets: int) -> FileIO:
    """Return a file in memory, whose size cannot be changed; raises OSError where there is no room."""
    memory = FileIO(os.memfd_create("evstim-renderer", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING), "r+")
    os.posix_fallocate(memory.fileno(), 0, octets)
    fcntl.fcntl(memory, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
    return memory
