"""The frame of AEDAT 4.0 files, to recover one that was cut: where its header says the table is, and its whole packets.

    14 bytes  #!AER-DAT4.0 CR LF
    u32       size of the header, a FlatBuffer "IOHE": compression, i64 place of the table (-1: none), XML
    packets   i32 stream   i32 size   payload
    table     (compressed) "FTAB", in finished files

Sources: docs.inivation.com, "AEDAT 4.0"; flatbuffers.dev, "FlatBuffer Internals".
"""

from __future__ import annotations

import struct

__all__ = ["MAGIC", "Aedat4Head", "packet_at"]

MAGIC = b"#!AER-DAT4.0\r\n"
_MOST_HEADER = 1 << 24
_TABLE_SLOT = 1  # of the fields of IOHE
_STREAMS = 256


class Aedat4Head:
    """The header of a file, of its first bytes; raises ValueError where these are none, or not all of it.

    Attributes
    ----------
    packets_at : where the packets begin.
    table_at : where the table begins; -1 for a file that was not finished.
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
        """Return the header with no place of a table, as it is while a file is written."""
        if not self._place:
            return self._data
        return self._data[: self._place] + struct.pack("<q", -1) + self._data[self._place + 8 :]


def _field_at(data: bytes, start: int, slot: int) -> int:
    """Return where a field of the root table of a FlatBuffer at `start` lies; 0 where it has its default."""
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
