"""TCP port for one external renderer, and the slots that its images come in.

    server = RendererServer("127.0.0.1", 5560)
    connection = server.accept(wanted, wait_s=30)      HELLO, CAMERA, READY
    connection.request(t_ns)                           a DRAW into a free slot
    image = connection.receive(timeout_s=5)            its planes are views of the slot: no copy
    connection.release(image)                          the slot may be drawn into again

The pixels come over the socket, read straight into the slot, or are written by the renderer into memory that both map:
a file of /dev/shm, whose name is removed as soon as the renderer has mapped it, so that nothing is left behind whatever
ends. Its room is reserved in advance: a full memory is an error at the start, not a signal later.

One renderer is served; the port closes when it is accepted. A peer that is not allowed, sends something else or
nothing is disconnected, and the next one is accepted until the time is over.
"""

from __future__ import annotations

import math
import mmap
import os
import socket
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.renderer.messages import (
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

__all__ = ["Drawn", "RendererConnection", "RendererEnded", "RendererError", "RendererServer"]

_GREETING_S = 2.0
_SEND_S = 5.0
_BACKLOG = 4

_Bytes = npt.NDArray[np.uint8]


class RendererError(Exception):
    """The renderer cannot be used any longer; the message gives the reason."""


class RendererEnded(RendererError):
    """The renderer has reached the end of its scene."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """One image.

    Attributes
    ----------
    head : number, time and bound on motion.
    slot : of its pixels.
    planes : (height, width) or (height, width, 2) arrays by name, views of the slot; valid until it is released.
    """

    head: Image
    slot: int
    planes: dict[str, npt.NDArray[Any]]


class RendererServer:
    """TCP port on `host` and `port` (0: any free one) for a renderer at one of `allow`; raises OSError."""

    def __init__(self, host: str, port: int, allow: Sequence[str] = ()) -> None:
        self._allow = AllowList(allow)
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._listener = socket.create_server((host, port), family=family, backlog=_BACKLOG)
        self.refusals: list[str] = []

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the port."""
        host, port = self._listener.getsockname()[:2]
        return host, port

    def accept(self, wanted: Camera, wait_s: float) -> RendererConnection | None:
        """Return the connection of a renderer that draws for the camera `wanted`; None where none came in time.

        Slot size and path of `wanted` are not used. Afterwards the port is closed. Raises OSError where the shared
        memory has no room.
        """
        until_s = time.monotonic() + wait_s
        try:
            while (left_s := until_s - time.monotonic()) > 0:
                self._listener.settimeout(left_s)
                try:
                    peer, address = self._listener.accept()
                except TimeoutError:
                    break
                connection = self._greeted(peer, address[0], wanted)
                if connection is not None:
                    return connection
            return None
        finally:
            self.close()

    def close(self) -> None:
        """Close the port; a second call does nothing."""
        self._listener.close()

    def _greeted(self, peer: socket.socket, address: str, wanted: Camera) -> RendererConnection | None:
        """Return the connection of one peer; None, and a line in `refusals`, where it is no renderer."""
        stream = _Stream(peer)
        try:
            if not self._allow.permits(address):
                raise RendererError("its address is not allowed")
            return RendererConnection(stream, wanted)
        except (RendererError, MessageError) as error:
            self.refusals.append(f"{address}: {error}")
            stream.send_last(End(str(error)).pack())
            stream.close()
        except BaseException:
            stream.close()
            raise
        return None


class _Stream:
    """Messages over a socket, each wait limited."""

    def __init__(self, peer: socket.socket) -> None:
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = peer

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

    def read_into(self, target: memoryview, until_s: float) -> None:
        while target:
            try:
                self._socket.settimeout(max(until_s - time.monotonic(), 1e-3))
                count = self._socket.recv_into(target)
            except TimeoutError:
                raise RendererError("nothing more came in time") from None
            except OSError as error:
                raise RendererError(f"the connection broke: {error.strerror or error}") from error
            if not count:
                raise RendererError("it closed the connection in the middle of its scene")
            target = target[count:]

    def read(self, count: int, until_s: float) -> bytes:
        octets = bytearray(count)
        self.read_into(memoryview(octets), until_s)
        return bytes(octets)

    def expect(self, kind: Type, most: int, until_s: float) -> int:
        """Return the length of the next message, of type `kind`; raises RendererEnded for an END."""
        header = parse_header(self.read(HEADER_OCTETS, until_s))
        if header.type is Type.END:
            reason = End.parse(self.read(min(header.length, 1001), until_s)).reason
            raise RendererError(f"it ended: {reason}") if reason else RendererEnded("its scene has ended")
        if header.type is not kind:
            raise MessageError(f"{header.type.name} came instead of {kind.name}")
        if header.length > most:
            raise MessageError(f"{kind.name} has {header.length} octets, at most {most} are expected")
        return header.length

    def close(self) -> None:
        self._socket.close()


class RendererConnection:
    """The connection to one renderer, and its slots; made by `RendererServer.accept`.

    Attributes
    ----------
    hello : the images that it gives.
    """

    def __init__(self, stream: _Stream, wanted: Camera) -> None:
        until_s = time.monotonic() + _GREETING_S
        self._stream = stream
        self.hello = Hello.parse(stream.read(stream.expect(Type.HELLO, 80, until_s), until_s))
        self._size = wanted.size
        self._planes = planes_of(self.hello, wanted.size)
        octets = slot_octets(self.hello, wanted.size)
        self._memory = _Memory(wanted.slots * octets, shared=self.hello.shared)
        try:
            stream.send(replace(wanted, slot_octets=octets, path=self._memory.path).pack())
            stream.expect(Type.READY, 0, time.monotonic() + _GREETING_S)
        except BaseException:
            self._memory.close()
            raise
        self._memory.unlink()
        self._slots = [self._memory.octets[k * octets : (k + 1) * octets] for k in range(wanted.slots)]
        self._free = deque(range(wanted.slots))
        self._requested: deque[Draw] = deque()
        self._count = 0

    @property
    def free(self) -> int:
        """Number of slots that nothing uses."""
        return len(self._free)

    @property
    def requested(self) -> int:
        """Number of requests without an image so far."""
        return len(self._requested)

    def request(self, t_ns: int = ANY_TIME, pose: tuple[float, ...] | None = None) -> None:
        """Request the image of `t_ns`, seen from `pose`, into a free slot; raises RendererError, also when closed."""
        slot = self._free.popleft()
        draw = Draw(self._count, t_ns, slot) if pose is None else Draw(self._count, t_ns, slot, pose)
        self._count += 1
        self._requested.append(draw)
        self._stream.send(draw.pack())

    def receive(self, timeout_s: float) -> Drawn:
        """Return the image of the oldest request; raises RendererError, RendererEnded and MessageError."""
        draw, until_s = self._requested[0], time.monotonic() + timeout_s
        pixels = 0 if self.hello.shared else self._slots[draw.slot].size
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
        if pixels:
            self._stream.read_into(memoryview(self._slots[draw.slot]), until_s)  # type: ignore[arg-type]
        self._requested.popleft()
        return Drawn(head, draw.slot, {plane.name: self._view(plane, draw.slot) for plane in self._planes})

    def release(self, image: Drawn) -> None:
        """Give the slot of an image back, whose planes are not used any more."""
        self._free.append(image.slot)

    def close(self, reason: str = "") -> None:
        """End the connection; a second call does nothing."""
        self._stream.send_last(End(reason).pack())
        self._stream.close()
        self._slots = []
        self._memory.close()

    def _view(self, plane: Plane, slot: int) -> npt.NDArray[Any]:
        width, height = self._size
        shape = (height, width) if plane.channels == 1 else (height, width, plane.channels)
        return np.frombuffer(self._slots[slot], plane.dtype, math.prod(shape), plane.offset).reshape(shape)


class _Memory:
    """Octets of all slots: of this process, or a mapped file that another process opens by `path`; raises OSError."""

    def __init__(self, octets: int, *, shared: bool) -> None:
        self.path = ""
        if not shared:
            self.octets: _Bytes = np.zeros(octets, np.uint8)
            return
        folder = "/dev/shm" if Path("/dev/shm").is_dir() else None
        descriptor, self.path = tempfile.mkstemp(prefix="evstim-renderer-", dir=folder)
        try:
            os.posix_fallocate(descriptor, 0, octets)
            self.octets = np.frombuffer(mmap.mmap(descriptor, octets), np.uint8)
        except OSError:
            self.unlink()
            raise
        finally:
            os.close(descriptor)

    def unlink(self) -> None:
        """Remove the file's name; a second call does nothing."""
        if self.path:
            Path(self.path).unlink(missing_ok=True)
        self.path = ""

    def close(self) -> None:
        """Remove the name; the memory is given back with the last view of it."""
        self.unlink()
        self.octets = np.zeros(0, np.uint8)
