"""Messages between evstim and an external renderer, over one byte stream (TCP or a Unix socket), little-endian.

Every message begins with a header of 16 octets:

     0  char[4]   "EVSR"
     4  u16       type
     6  u16       version, 1
     8  u64       length of the rest, octets

    renderer                             evstim
    HELLO (1) -------------------------> checks it
              <------------------------- CAMERA (2)
    READY (3) -------------------------> with shared memory: the renderer has mapped the file
              <------------------------- DRAW (4), as many as there are slots
    IMAGE (5) -------------------------> one for each DRAW, in their order
    END (6)   <------------------------> from either side; the connection closes

HELLO, 80 octets: the images that the renderer gives.

     0  u32       layers beside light: 1 motion, 2 depth, 4 rate, or their sum
     4  u8        levels: 0 float32, 1 u8, 2 u16
     5  u8        response: 0 linear, 1 sRGB
     6  u16       level of white, for u8 and u16 (255, 1023, 65535); 0 for float32
     8  u32       carrier of the pixels: 0 this stream, 1 shared memory
    12  u32       0
    16  char[64]  name of the renderer, UTF-8, filled with zeros

CAMERA, 40 octets and a path: the camera without distortion, its boresight in the middle of the image.

     0  u32 u32   width, height, px
     8  f64       focal length over pixel pitch, px
    16  i64       time from one image to the next, ns; 0: the renderer gives the times
    24  u32       slots
    28  u32       1: DRAW has the pose of the camera; 0: it has none
    32  u64       octets of a slot
    40  char[]    path of the file of the shared memory, UTF-8; empty without

The file has no name in a folder: its path, /proc/PID/fd/NUMBER, leads to a descriptor of evstim's process. The renderer
opens it for reading and writing, without O_TRUNC, and maps it (MAP_SHARED). Its size is sealed: it cannot be changed. A
slot belongs to the renderer from the DRAW that names it to its IMAGE. Then evstim copies it, and looks at the copy
alone; what is written into the slot after the IMAGE, and before the next DRAW that names it, is in no image or spoils
one.

DRAW, 80 octets: a request of one image.

     0  u64       number of the request, 0, 1, 2, ...
     8  i64       stream time of the image, ns; -2^63: the renderer's choice, later than the last one
    16  u32       slot of the shared memory to write into
    20  u32       0
    24  f64[3]    position of the camera in the world, m; NaN without a pose
    48  f64[4]    q_world_from_camera, scalar first, axes of OpenCV; NaN without a pose

IMAGE, 24 octets, then the pixels if they come over the stream:

     0  u64       number of the request
     8  i64       time of the image, ns: that of the request, where it has one
    16  f64       bound on the motion of all points of the image, px/s; NaN: not known

The pixels of a slot, or of an IMAGE, are planes, row 0 on top, each filled with zeros to a multiple of 64 octets:

    light    (height, width) float32, u8 or u16: radiance over that of white
    motion   (height, width, 2) float32: velocity of the visible point at the middle of the pixel, px/s, to the right
             and down
    depth    (height, width) float32: m along the boresight; infinite for the sky
    rate     (height, width) float32: time derivative of the light, 1/s

END: the reason, UTF-8, at most 1000 octets; empty where the renderer has reached the end of its scene.

Own layout. A message of a wrong type, length or version is an error, and ends the connection.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Any, ClassVar


class MessageError(ValueError):
    """The octets are no valid message; the text gives the reason."""


class Type(IntEnum):
    """Types of messages."""

    HELLO = 1
    CAMERA = 2
    READY = 3
    DRAW = 4
    IMAGE = 5
    END = 6


class Layers(IntFlag):
    """Planes beside light."""

    NONE = 0
    MOTION = 1
    DEPTH = 2
    RATE = 4


class Levels(IntEnum):
    """Types of the numbers of light."""

    FLOAT32 = 0
    U8 = 1
    U16 = 2

    @property
    def octets(self) -> int:
        """Size of one number."""
        return int(_LIGHT[self][-1])


class Response(IntEnum):
    """Relation of levels to light."""

    LINEAR = 0
    SRGB = 1


_MAGIC = b"EVSR"
_VERSION = 1
_HEADER = struct.Struct("<4sHHQ")
_HELLO = struct.Struct("<IBBHII64s")
_CAMERA = struct.Struct("<IIdqIIQ")
_DRAW = struct.Struct("<QqII7d")
_IMAGE = struct.Struct("<Qqd")
_ALIGNED = 64
_MOST_REASON = 1000
_NO_POSE = (math.nan,) * 7
_LIGHT = ("<f4", "u1", "<u2")  # by the value of Levels

HEADER_OCTETS = _HEADER.size
ANY_TIME = -(1 << 63)
"""Time of a request whose image may have any later time."""


def parse_header(octets: bytes) -> tuple[Type, int]:
    """Return the type of a message, and the length of the rest of it, from its first 16 octets; raises MessageError."""
    magic, number, version, length = _HEADER.unpack(octets)
    if magic != _MAGIC:
        raise MessageError(f"a message begins with {magic!r}, not with {_MAGIC!r}: this is no renderer of evstim's")
    if version != _VERSION:
        raise MessageError(f"version {version} of the messages is not supported: use version {_VERSION}")
    try:
        return Type(number), length
    except ValueError:
        raise MessageError(f"there is no message of type {number}") from None


def _message(kind: Type, body: bytes, more_octets: int = 0) -> bytes:
    return _HEADER.pack(_MAGIC, kind, _VERSION, len(body) + more_octets) + body


def _unpacked(kind: Type, form: struct.Struct, octets: bytes) -> tuple[Any, ...]:
    if len(octets) != form.size:
        raise MessageError(f"{kind.name} has {len(octets)} octets, not {form.size}")
    return form.unpack(octets)


@dataclass(frozen=True)
class Hello:
    """The images that a renderer gives; raises MessageError if the values do not belong together.

    Attributes
    ----------
    layers : planes beside light.
    levels, response, white : numbers of light, their relation to light, and the level of white; 0 for floats.
    shared : True: the pixels come through shared memory.
    name : the renderer's name, at most 64 octets.
    """

    layers: Layers = Layers.NONE
    levels: Levels = Levels.FLOAT32
    response: Response = Response.LINEAR
    white: int = 0
    shared: bool = False
    name: str = ""

    OCTETS: ClassVar[int] = _HELLO.size

    def __post_init__(self) -> None:
        if self.levels is Levels.FLOAT32:
            if self.white or self.response is not Response.LINEAR:
                raise MessageError("light of float32 is linear: response and level of white must be 0")
        elif not 1 <= self.white < 1 << 8 * self.levels.octets:
            raise MessageError(f"the level of white is {self.white}: it must fit into {self.levels.octets} octets")

    def pack(self) -> bytes:
        """Return the message."""
        name = self.name.encode()[:64]
        body = _HELLO.pack(self.layers, self.levels, self.response, self.white, self.shared, 0, name)
        return _message(Type.HELLO, body)

    @classmethod
    def parse(cls, octets: bytes) -> Hello:
        """Return the value of the octets after the header; raises MessageError."""
        layers, levels, response, white, carrier, zero, name = _unpacked(Type.HELLO, _HELLO, octets)
        if layers > 7 or levels > 2 or response > 1 or carrier > 1 or zero:
            raise MessageError(
                f"HELLO has layers {layers} (0 to 7), levels {levels} (0 to 2), response {response} (0 or 1), carrier "
                f"{carrier} (0 or 1) and {zero} (0)"
            )
        text = name.rstrip(b"\0").decode(errors="replace")
        shown = "".join(letter if letter.isprintable() else "?" for letter in text)
        return cls(Layers(layers), Levels(levels), Response(response), white, bool(carrier), shown)


@dataclass(frozen=True)
class Camera:
    """The camera that a renderer draws for; see the module's docstring for the units."""

    size: tuple[int, int]
    focal_px: float
    period_ns: int
    slots: int
    slot_octets: int
    has_pose: bool = False
    path: str = ""

    def pack(self) -> bytes:
        """Return the message."""
        numbers = (*self.size, self.focal_px, self.period_ns, self.slots, self.has_pose, self.slot_octets)
        return _message(Type.CAMERA, _CAMERA.pack(*numbers) + self.path.encode())

    @classmethod
    def parse(cls, octets: bytes) -> Camera:
        """Return the value of the octets after the header; raises MessageError."""
        if len(octets) < _CAMERA.size:
            raise MessageError(f"CAMERA has {len(octets)} octets, at least {_CAMERA.size} are needed")
        width, height, focal_px, period_ns, slots, has_pose, size = _CAMERA.unpack_from(octets)
        path = octets[_CAMERA.size :].decode(errors="replace")
        return cls((width, height), focal_px, period_ns, slots, size, bool(has_pose), path)


READY = _message(Type.READY, b"")
"""The message by which a renderer reports that it can draw."""


@dataclass(frozen=True)
class Draw:
    """A request of one image.

    Attributes
    ----------
    number : of the request.
    t_ns : stream time of the image, or `ANY_TIME`.
    slot : of the shared memory.
    pose : position in m and q_world_from_camera, scalar first; all NaN without a pose.
    """

    number: int
    t_ns: int
    slot: int
    pose: tuple[float, ...] = _NO_POSE

    def pack(self) -> bytes:
        """Return the message."""
        return _message(Type.DRAW, _DRAW.pack(self.number, self.t_ns, self.slot, 0, *self.pose))

    @classmethod
    def parse(cls, octets: bytes) -> Draw:
        """Return the value of the octets after the header; raises MessageError."""
        number, t_ns, slot, _, *pose = _unpacked(Type.DRAW, _DRAW, octets)
        return cls(number, t_ns, slot, tuple(pose))


@dataclass(frozen=True)
class Image:
    """An image, without its pixels.

    Attributes
    ----------
    number : of the request that it answers.
    t_ns : its time.
    motion_bound_px_s : of all its points; NaN where not known.
    """

    number: int
    t_ns: int
    motion_bound_px_s: float = math.nan

    OCTETS: ClassVar[int] = _IMAGE.size

    def pack(self, pixel_octets: int = 0) -> bytes:
        """Return the message, up to the `pixel_octets` that follow it."""
        return _message(Type.IMAGE, _IMAGE.pack(self.number, self.t_ns, self.motion_bound_px_s), pixel_octets)

    @classmethod
    def parse(cls, octets: bytes) -> Image:
        """Return the value of the first 24 octets after the header; raises MessageError."""
        number, t_ns, bound = _unpacked(Type.IMAGE, _IMAGE, octets)
        if bound < 0:
            raise MessageError(f"the bound on motion is {bound:g} px/s: it must be 0 or above, or NaN")
        return cls(number, t_ns, bound)


@dataclass(frozen=True)
class End:
    """End of the connection, and its reason; "" for the end of the scene."""

    reason: str = ""

    def pack(self) -> bytes:
        """Return the message."""
        return _message(Type.END, self.reason.encode()[:_MOST_REASON])

    @classmethod
    def parse(cls, octets: bytes) -> End:
        """Return the value of the octets after the header; raises MessageError."""
        if len(octets) > _MOST_REASON:
            raise MessageError(f"the reason of END has {len(octets)} octets, at most {_MOST_REASON} are allowed")
        text = octets.decode(errors="replace")
        return cls("".join(letter if letter.isprintable() else "?" for letter in text))


@dataclass(frozen=True)
class Plane:
    """One plane of pixels in a slot: "light", "motion", "depth" or "rate", its type, channels and first octet."""

    name: str
    dtype: str
    channels: int
    offset: int


def planes_of(hello: Hello, size: tuple[int, int]) -> tuple[Plane, ...]:
    """Return the planes of the images of `size` = (width, height) px that a renderer gives, light first."""
    beside = (("motion", 2, Layers.MOTION), ("depth", 1, Layers.DEPTH), ("rate", 1, Layers.RATE))
    extra = [(name, "<f4", channels) for name, channels, layer in beside if hello.layers & layer]
    planes, offset = [], 0
    for name, dtype, channels in (("light", _LIGHT[hello.levels], 1), *extra):
        planes.append(Plane(name, dtype, channels, offset))
        offset += _aligned(size[0] * size[1] * channels * int(dtype[-1]))
    return tuple(planes)


def slot_octets(hello: Hello, size: tuple[int, int]) -> int:
    """Return the octets of the pixels of one image of `size` = (width, height) px."""
    last = planes_of(hello, size)[-1]
    return last.offset + _aligned(size[0] * size[1] * last.channels * int(last.dtype[-1]))


def _aligned(octets: int) -> int:
    return -(-octets // _ALIGNED) * _ALIGNED
