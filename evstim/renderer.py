"""Client for renderers: images for a rig whose scene is `kind = "external"`. One file, numpy alone: copy it freely.

    from evstim.renderer import Images, Renderer

    with Renderer("127.0.0.1:5560", Images(motion=True)) as renderer:
        camera = renderer.camera                      # width, height, focal_px
        for image in renderer:                        # until evstim ends
            image.light[:] = ...                      # (height, width), radiance over that of white
            image.motion[:] = ...                     # (height, width, 2), px/s, to the right and down
            image.send()

A loop over a `Renderer` gives one `Image` for each request, with its time `image.t_ns` in ns. Where the rig lets the
renderer choose the times (`images = "pushed"`), `image.t_ns` is None, and `image.send(t_ns=...)` gives it. All arrays
are to be filled completely. They are those of the shared memory, where that is used, so `send` makes them read-only:
evstim copies them then.

The messages are drawn in evstim's docs/renderers.md. This file is in the public domain (CC0), so that renderers under
any licence can use it.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import socket
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt

_HEADER = struct.Struct("<4sHHQ")
_HELLO = struct.Struct("<IBBHII64s")
_CAMERA = struct.Struct("<IIdqIIQ")
_DRAW = struct.Struct("<QqII7d")
_IMAGE = struct.Struct("<Qqd")
_HELLO_TYPE, _CAMERA_TYPE, _READY_TYPE, _DRAW_TYPE, _IMAGE_TYPE, _END_TYPE = range(1, 7)
_ANY_TIME = -(1 << 63)
_THIS_MACHINE = ("127.0.0.1", "localhost", "::1")
_LEVELS = {"float32": (0, "<f4"), "uint8": (1, "u1"), "uint16": (2, "<u2")}


class RendererRefused(Exception):
    """evstim refused this renderer or one of its images; the message gives the reason."""


@dataclass(frozen=True)
class Images:
    """The images that a renderer gives.

    Attributes
    ----------
    levels : type of the light's numbers; integers need `white`, the level of white.
    srgb : True: integer levels follow the curve of sRGB; False: they are proportional to light.
    motion, depth, rate : True: images have this layer.
    """

    levels: Literal["float32", "uint8", "uint16"] = "float32"
    white: int = 0
    srgb: bool = False
    motion: bool = False
    depth: bool = False
    rate: bool = False

    @property
    def planes(self) -> tuple[tuple[str, str, int], ...]:
        """Name, numpy type and channels of each plane."""
        beside = (("motion", 2, self.motion), ("depth", 1, self.depth), ("rate", 1, self.rate))
        extra = ((name, "<f4", channels) for name, channels, used in beside if used)
        return (("light", _LEVELS[self.levels][1], 1), *extra)


@dataclass(frozen=True)
class Camera:
    """The camera to draw for: no distortion, boresight in the middle of the image.

    Attributes
    ----------
    width, height : px.
    focal_px : focal length over pixel pitch.
    period_ns : time from one image to the next; 0: the renderer gives the times.
    has_pose : True: each image has the pose of the camera.
    """

    width: int
    height: int
    focal_px: float
    period_ns: int
    has_pose: bool

    @property
    def vertical_field_deg(self) -> float:
        """Field of view over the height, edge to edge, as most renderers take it."""
        return math.degrees(2 * math.atan(self.height / 2 / self.focal_px))


@dataclass(frozen=True)
class Pose:
    """Position of the camera in the world, m, and its attitude, scalar first, axes of OpenCV (x right, y down)."""

    position_m: tuple[float, ...]
    q_world_from_camera: tuple[float, ...]


@dataclass(eq=False)
class Image:
    """One requested image: arrays to fill, and `send`.

    Attributes
    ----------
    t_ns : time of the image; None: give it to `send`.
    pose : of the camera; None where the rig has no path for it.
    light : (height, width) of the renderer's `levels`: radiance over that of white.
    motion : (height, width, 2) float32, velocity of the visible points, px/s, to the right and down; None without.
    depth : (height, width) float32, m along the boresight, infinite for the sky; None without.
    rate : (height, width) float32, time derivative of light, 1/s; None without.
    """

    t_ns: int | None
    pose: Pose | None
    _number: int = field(repr=False)
    _renderer: Renderer = field(repr=False)
    light: npt.NDArray[Any] = field(repr=False)
    motion: Any = field(default=None, repr=False)
    depth: Any = field(default=None, repr=False)
    rate: Any = field(default=None, repr=False)

    def send(self, t_ns: int | None = None, motion_bound_px_s: float = math.nan) -> None:
        """Send the image; `motion_bound_px_s` bounds the motion of all its points, NaN where that is not known."""
        frame_ns = self.t_ns if t_ns is None else t_ns
        if frame_ns is None:
            raise ValueError("this rig leaves the times to the renderer: send(t_ns=...)")
        for plane in (self.light, self.motion, self.depth, self.rate):
            if plane is not None:
                plane.flags.writeable = False
        self._renderer._send_image(self._number, frame_ns, motion_bound_px_s)


class Renderer:
    """Connection to evstim at `address`, "HOST:PORT"; a context manager, and an iterator over requested images.

    Parameters
    ----------
    images : their layout.
    shared : True: through shared memory, on one machine; False: through the connection. None: by the address.
    name : the renderer's name, for evstim's summary.
    wait_s : time to wait until evstim listens.

    Attributes
    ----------
    camera : the camera to draw for.

    Raises
    ------
    RendererRefused
        evstim refused the connection.
    OSError
        evstim does not listen there, or the connection broke.
    """

    def __init__(
        self,
        address: str,
        images: Images = Images(),
        *,
        shared: bool | None = None,
        name: str = "",
        wait_s: float = 60.0,
    ) -> None:
        host, _, port = address.rpartition(":")
        self._images = images
        self._socket = _connected(host.strip("[]"), int(port), wait_s)
        try:
            self.camera = self._greet(host in _THIS_MACHINE if shared is None else shared, name)
        except BaseException:
            self._socket.close()
            raise

    def __iter__(self) -> Iterator[Image]:
        while (message := self._receive()) is not None:
            kind, body = message
            if kind != _DRAW_TYPE:
                raise RendererRefused(f"a message of type {kind} came instead of a request")
            number, t_ns, slot, _, *pose = _DRAW.unpack(body)
            self._slot = slot
            place = None if math.isnan(pose[0]) else Pose(tuple(pose[:3]), tuple(pose[3:]))
            planes = {name: plane.view() for name, plane in self._slots[slot].items()}
            yield Image(None if t_ns == _ANY_TIME else t_ns, place, number, self, **planes)

    def end(self, reason: str = "") -> None:
        """Report the end of the scene to evstim, or the reason why no more images can be drawn, and disconnect."""
        self._send(_END_TYPE, reason.encode()[:1000])
        self.close()

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, Exception) and self._socket.fileno() >= 0:
            with contextlib.suppress(OSError):
                self.end(f"{type(error).__name__}: {error}")
        self.close()

    def _greet(self, shared: bool, name: str) -> Camera:
        images = self._images
        layers = images.motion | images.depth << 1 | images.rate << 2
        head = (layers, _LEVELS[images.levels][0], images.srgb, images.white, shared, 0, name.encode()[:64])
        self._send(_HELLO_TYPE, _HELLO.pack(*head))
        message = self._receive()
        if message is None or message[0] != _CAMERA_TYPE:
            raise RendererRefused("evstim ended the connection")
        width, height, focal_px, period_ns, slots, has_pose, octets = _CAMERA.unpack_from(message[1])
        path = message[1][_CAMERA.size :].decode()
        self._shared = bool(path)
        self._memories = _memories(path, slots, octets)
        self._slots = [self._planes(memory, (height, width)) for memory in self._memories]
        self._send(_READY_TYPE, b"")
        return Camera(width, height, focal_px, period_ns, bool(has_pose))

    def _planes(self, memory: memoryview, shape: tuple[int, int]) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays of one slot by name."""
        planes: dict[str, npt.NDArray[Any]] = {}
        offset = 0
        for name, dtype, channels in self._images.planes:
            image_shape = shape if channels == 1 else (*shape, channels)
            planes[name] = np.frombuffer(memory, dtype, math.prod(image_shape), offset).reshape(image_shape)
            offset += -(-planes[name].nbytes // 64) * 64
        return planes

    def _send_image(self, number: int, t_ns: int, bound_px_s: float) -> None:
        head = _IMAGE.pack(number, t_ns, bound_px_s)
        if self._shared:
            self._send(_IMAGE_TYPE, head)
            return
        pixels = self._memories[self._slot]
        self._send(_IMAGE_TYPE, head, len(head) + len(pixels))
        self._deliver(pixels)

    def _send(self, kind: int, body: bytes, length: int | None = None) -> None:
        self._deliver(_HEADER.pack(b"EVSR", kind, 1, len(body) if length is None else length) + body)

    def _deliver(self, octets: bytes | memoryview) -> None:
        try:
            self._socket.sendall(octets)
        except (BrokenPipeError, ConnectionResetError):  # the reason, if there is one, is the next message
            return

    def _receive(self) -> tuple[int, bytes] | None:
        """Return type and rest of the next message; None at the end. Raises RendererRefused."""
        header = self._read(_HEADER.size)
        if header is None:
            return None
        _, kind, _, length = _HEADER.unpack(header)
        body = self._read(length)
        if body is None:
            return None
        if kind != _END_TYPE:
            return kind, body
        if body:
            raise RendererRefused(body.decode(errors="replace"))
        return None

    def _read(self, count: int) -> bytes | None:
        octets = bytearray()
        while len(octets) < count:
            try:
                part = self._socket.recv(count - len(octets))
            except ConnectionResetError:
                return None
            if not part:
                return None
            octets += part
        return bytes(octets)


def _connected(host: str, port: int, wait_s: float) -> socket.socket:
    until_s = time.monotonic() + wait_s
    while True:
        try:
            peer = socket.create_connection((host, port))
        except ConnectionRefusedError:
            if time.monotonic() > until_s:
                raise
            time.sleep(0.05)
            continue
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return peer


def _memories(path: str, slots: int, octets: int) -> list[memoryview]:
    """Return the memory of each slot: shared, if there is a path; raises OSError."""
    if not path:
        return [memoryview(bytearray(octets))] * slots
    with contextlib.suppress(OSError, ValueError), open(path, "r+b", buffering=0) as file:
        memory = memoryview(mmap.mmap(file.fileno(), 0))
        if len(memory) == slots * octets:  # in another container the path leads to another program's file
            return [memory[k * octets : (k + 1) * octets] for k in range(slots)]
    raise OSError(
        f"the shared memory {path} cannot be opened: evstim runs in another container or as another user; send the "
        "images through the connection, by Renderer(..., shared=False)"
    )
