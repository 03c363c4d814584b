"""The message of one pose from outside: a datagram, or a record in a byte stream, of 80 bytes, little-endian.

     0  char[4]   "EVPO"
     4  u16       version, 1
     6  u16       number: 0 the camera, 1 the first body, ...
     8  i64       stream time, ns; -1: now
    16  f64[3]    position in the world, m, each within 1e15 (6700 au)
    40  f64[4]    q_world_from_body, scalar first, unit within 0.1 %
    72  u32       counter of the sender, one more for each pose of this number; it starts anywhere and wraps
    76  u32       CRC-32 (zlib) of bytes 0 to 75

Camera axes are OpenCV's (x right, y down, z along the boresight). Own layout; a struct format of "<4sHHq3d4dII".
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass

_LAYOUT = struct.Struct("<4sHHq3d4dI")
_CRC = struct.Struct("<I")
_MAGIC = b"EVPO"
_VERSION = 1
_UNIT_WITHIN = 1e-3
_FARTHEST_M = 1e15  # motion between two such positions can be extrapolated without overflow

POSE_BYTES = _LAYOUT.size + _CRC.size
NOW = -1
"""Time of a pose that holds from its arrival."""


class PoseMessageError(ValueError):
    """The bytes are no pose; the message gives the reason."""


@dataclass(frozen=True)
class PoseMessage:
    """One pose of one body; raises PoseMessageError for a value that cannot be sent, or that is not a pose.

    Attributes
    ----------
    t_ns : stream time, or `NOW`.
    position_m : in the world.
    q_world_from_body : unit quaternion, scalar first.
    body : 0 the camera, 1 the first body, ...
    counter : of the sender, modulo 2^32.
    """

    t_ns: int
    position_m: tuple[float, float, float]
    q_world_from_body: tuple[float, float, float, float]
    body: int = 0
    counter: int = 0

    def __post_init__(self) -> None:
        if self.t_ns < NOW:
            raise PoseMessageError(f"time {self.t_ns}: stream time in ns, or {NOW} for now")
        if not all(map(math.isfinite, (*self.position_m, *self.q_world_from_body))):
            raise PoseMessageError(f"place {self.position_m}, attitude {self.q_world_from_body}: all must be finite")
        if max(map(abs, self.position_m)) > _FARTHEST_M:
            raise PoseMessageError(f"place {self.position_m}: more than {_FARTHEST_M:g} m from the origin")
        length = math.hypot(*self.q_world_from_body)
        if abs(length - 1) >= _UNIT_WITHIN:
            raise PoseMessageError(f"attitude {self.q_world_from_body} has length {length:.4g}: it must be 1")
        if not (0 <= self.body < 1 << 16 and 0 <= self.counter < 1 << 32):
            raise PoseMessageError(f"body {self.body} and counter {self.counter}: 16 and 32 bits without sign")

    def __bytes__(self) -> bytes:
        fixed = (_MAGIC, _VERSION, self.body, self.t_ns)
        data = _LAYOUT.pack(*fixed, *self.position_m, *self.q_world_from_body, self.counter)
        return data + _CRC.pack(zlib.crc32(data))

    @classmethod
    def parse(cls, data: bytes) -> PoseMessage:
        """Read one message; raises PoseMessageError."""
        if len(data) != POSE_BYTES:
            raise PoseMessageError(f"a pose has {POSE_BYTES} bytes, got {len(data)}")
        if zlib.crc32(data[: -_CRC.size]) != _CRC.unpack_from(data, _LAYOUT.size)[0]:
            raise PoseMessageError("the checksum does not fit: damaged on its way, or computed otherwise")
        magic, version, body, t_ns, *numbers, counter = _LAYOUT.unpack_from(data)
        if magic != _MAGIC or version != _VERSION:
            raise PoseMessageError(f"starts with {magic!r}, version {version}: expected {_MAGIC!r}, {_VERSION}")
        x, y, z, w, i, j, k = numbers
        return cls(t_ns, (x, y, z), (w, i, j, k), body, counter)
