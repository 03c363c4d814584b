"""The payload of a frame in AEDAT 4.0: a FlatBuffer "FRME" with its size before it. All little-endian.

    u32 size of what follows   u32 place of the table   "FRME"
    vtable   u16 own size, u16 size of the table, 11 x u16 place of a field in the table
    table    i32 back to the vtable   u8 format: 0 grey, 8 bits
             i64 t, start of frame, end of frame, start of exposure, end of exposure, us
             i16 columns, rows, first column, first row   u32 to the pixels
    pixels   u32 number   bytes, row after row

Numbers lie at multiples of their size, counted from the first size on. Sources: docs.inivation.com, "AEDAT 4.0";
flatbuffers.dev, "FlatBuffer Internals"; read by faery 0.7.1.
"""

from __future__ import annotations

import struct

import numpy as np
import numpy.typing as npt

__all__ = ["aedat4_picture"]

_PLACES = (8, 16, 24, 32, 40, 4, 48, 50, 52, 54, 56)
_TABLE_BYTES = 60
_HEAD_BYTES = 8  # place of the table and the name, in front of the vtable


def aedat4_picture(
    times_us: tuple[int, int, int, int, int], pixels: npt.NDArray[np.uint8], origin: tuple[int, int] = (0, 0)
) -> bytes:
    """Return the payload of a grey picture, (rows, columns) uint8.

    `times_us` are its own, those of the frame's start and end, and those of the exposure's; `origin` is the first
    column and row of the array that it shows.
    """
    vtable = struct.pack(f"<{2 + len(_PLACES)}H", 2 * (2 + len(_PLACES)), _TABLE_BYTES, *_PLACES)
    at = _HEAD_BYTES + len(vtable)
    gap = -(at + 4) % 8
    table = struct.pack("<i4x5q4hI", at + gap - _HEAD_BYTES, *times_us, *pixels.shape[::-1], *origin, 4)
    head = struct.pack("<I4s", at + gap, b"FRME")
    body = head + vtable + bytes(gap) + table + struct.pack("<I", pixels.size) + pixels.tobytes()
    return struct.pack("<I", len(body)) + body
