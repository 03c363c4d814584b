"""AEDAT 4.0: the structure of a file, to recover one that was cut, and the payload of a frame.

    14 bytes  #!AER-DAT4.0 CR LF
    u32       size of the header, a FlatBuffer "IOHE": compression, i64 offset of the table (-1: none), XML
    packets   i32 stream   i32 size   payload
    table     (compressed) "FTAB", in finished files

Sources: docs.inivation.com, "AEDAT 4.0"; flatbuffers.dev, "FlatBuffer Internals".

The payload of a frame is a FlatBuffer "FRME" with its size before it. All little-endian.

    u32 size of the rest   u32 offset of the table   "FRME"
    vtable   u16 own size, u16 size of the table, 11 x u16 offset of a field in the table
    table    i32 back to the vtable   u8 format: 0 grey, 8 bits
             i64 t, start of frame, end of frame, start of exposure, end of exposure, us
             i16 columns, rows, first column, first row   u32 to the pixels
    pixels   u32 number   bytes, row after row

Numbers are at multiples of their size, counted from the first size on. Sources: as above; read by faery 0.7.1.
"""

from __future__ import annotations

import struct

import numpy as np
import numpy.typing as npt

MAGIC = b"#!AER-DAT4.0\r\n"
_MOST_HEADER = 1 << 24
_TABLE_SLOT = 1  # of the fields of IOHE
_STREAMS = 256


class Aedat4Head:
    """The header of a file, from its first bytes; raises ValueError if they are no header, or not all of it.

    `packets_at`: offset of the packets; `table_at`: offset of the table, -1 for a file that was not finished.
    """

    def __init__(self, data: bytes) -> None:
        if not data.startswith(MAGIC):
            raise ValueError("it is no AEDAT 4.0 file: it does not begin with #!AER-DAT4.0")
        start = len(MAGIC) + 4
        try:
            (size,) = struct.unpack_from("<I", data, len(MAGIC))
            if not 8 <= size <= _MOST_HEADER or start + size > len(data):
                raise ValueError("its header is cut")
            self.packets_at = start + size
            self._data = data[: self.packets_at]
            self._place = _field_at(self._data, start, _TABLE_SLOT)
            self.table_at: int = struct.unpack_from("<q", data, self._place)[0] if self._place else -1
        except struct.error as error:
            raise ValueError("its header is damaged") from error

    def unfinished(self) -> bytes:
        """Return the header without an offset of a table, as it is while a file is written."""
        if not self._place:
            return self._data
        return self._data[: self._place] + struct.pack("<q", -1) + self._data[self._place + 8 :]


def _field_at(data: bytes, start: int, slot: int) -> int:
    """Return the offset of a field of the root table of a FlatBuffer at `start`; 0 if it has its default."""
    table = start + struct.unpack_from("<I", data, start)[0]
    offsets = table - struct.unpack_from("<i", data, table)[0]
    if not start <= offsets < len(data) - 4:
        raise ValueError("its header is damaged")
    (size,) = struct.unpack_from("<H", data, offsets)
    if 4 + 2 * slot + 2 > size:
        return 0
    (offset,) = struct.unpack_from("<H", data, offsets + 4 + 2 * slot)
    return table + offset if offset else 0


def packet_at(head: bytes, left: int) -> int:
    """Return the bytes of the packet that begins with the 8 bytes of `head`; 0 where `left` bytes cannot hold it."""
    if len(head) < 8:
        return 0
    stream, size = struct.unpack("<ii", head)
    return 8 + size if 0 <= stream < _STREAMS and 0 < size <= left - 8 else 0


_PLACES = (8, 16, 24, 32, 40, 4, 48, 50, 52, 54, 56)
_TABLE_BYTES = 60
_HEAD_BYTES = 8  # offset of the table and the name, before the vtable


def aedat4_picture(
    t_us: int, begin_us: int, end_us: int, pixels: npt.NDArray[np.uint8], origin: tuple[int, int] = (0, 0)
) -> bytes:
    """Return the payload of a grey image, (rows, columns) uint8.

    `begin_us` and `end_us` are those of its exposure, which count as those of the frame; `origin` is the first column
    and row of the array that it shows.
    """
    vtable = struct.pack(f"<{2 + len(_PLACES)}H", 2 * (2 + len(_PLACES)), _TABLE_BYTES, *_PLACES)
    at = _HEAD_BYTES + len(vtable)
    gap = -(at + 4) % 8
    times_us = (t_us, begin_us, end_us, begin_us, end_us)
    table = struct.pack("<i4x5q4hI", at + gap - _HEAD_BYTES, *times_us, *pixels.shape[::-1], *origin, 4)
    head = struct.pack("<I4s", at + gap, b"FRME")
    body = head + vtable + bytes(gap) + table + struct.pack("<I", pixels.size) + pixels.tobytes()
    return struct.pack("<I", len(body)) + body
