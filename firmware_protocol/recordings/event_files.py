"""Binary files of events alone: DAT, and Event Stream with DVS events. Times are as they are stored.

DAT: lines of text that begin with `%`, among them `% Version 2`, `% Width 304` and `% Height 240`; u8 type of the
events, 0 (Event2D, as in GEN1 and N-CARS) or 12 (change detection), u8 their size, 8; then records, little-endian:

    u32 time, us   u32 column (14 bits), row (14 bits), polarity (4 bits)   version 1: 9 bits, 8 bits, 4 bits

faery writes `% T0`, the time in us that is 0 in the records.

Event Stream 2: "Event Stream", u8 x 3 version, u8 type 1, u16 width, u16 height; then octets:

    0xFF  127 us pass   0xFE  nothing   else  us since the event before (7 bits), polarity (1 bit); u16 column, u16 row

Rows of Event Stream count from the bottom. Sources: docs.prophesee.ai, "DAT file format"; event_stream of
neuromorphicsystems on GitHub.
"""

from __future__ import annotations

import re
import struct

import numpy as np
import numpy.typing as npt

from firmware_protocol.compiled import entry_of
from firmware_protocol.events import Bytes, Events, UInt16s, make_events

_DAT_TYPES = (0, 12)
_FIELDS = {1: (9, 8, 17), 2: (14, 14, 28)}  # bits of column and row, and place of the polarity


class DatDecoder:
    """Decoder of DAT in pieces, from the first bytes of its file; raises ValueError for other files.

    Attributes
    ----------
    start : offset of the first event.
    size : (width, height) of the sensor; None where the file does not give it.
    rest : octets of a record that is not complete.
    """

    damage, remarks = "", ()  # no record can be wrong

    def __init__(self, head: bytes) -> None:
        self.rest = b""
        self.start = 0
        while head[self.start : self.start + 1] == b"%":
            self.start = head.find(b"\n", self.start) + 1 or len(head)
        values = dict(re.findall(rb"(?mi)^% *(version|width|height|t0) +(\d{1,18})\s*$", head[: self.start].lower()))
        width, height, self._t0_us = (int(values.get(name, 0)) for name in (b"width", b"height", b"t0"))
        self.size = (width, height) if width and height else None
        version = int(values.get(b"version", 2))
        if version not in _FIELDS:
            raise ValueError(f"it is of version {version}; 1 and 2 are read")
        self._fields = _FIELDS[version]
        if len(head) < self.start + 2:
            raise ValueError("its header is cut")
        kind, size = head[self.start : self.start + 2]
        if kind not in _DAT_TYPES or size != 8:
            raise ValueError(f"its events are of type {kind} and have {size} octets; types 0 and 12 with 8 are read")
        self.start += 2

    def decode(self, data: bytes) -> Events:
        """Return (n,) EVENT of any next bytes, with part of a record at their ends."""
        data = self.rest + data
        count = len(data) // 8
        self.rest = data[8 * count :]
        words = np.frombuffer(data, "<u4", 2 * count).reshape(-1, 2)
        t, word = words[:, 0], words[:, 1]
        columns, rows, polarity = self._fields
        x, y = word & (1 << columns) - 1, word >> columns & (1 << rows) - 1
        return make_events(t + np.uint64(self._t0_us), x, y, (word >> polarity & 15) > 0)


_ES_HEAD = struct.Struct("<12s3BBHH")


class EventStreamDecoder:
    """Decoder of Event Stream in pieces, from the first bytes of its file; raises ValueError for other files.

    Attributes
    ----------
    start : offset of the first event.
    size : (width, height) of the sensor.
    rest : octets of a record that is not complete.
    """

    damage, remarks = "", ()

    def __init__(self, head: bytes) -> None:
        if len(head) < _ES_HEAD.size:
            raise ValueError("its header is cut")
        _, major, minor, patch, kind, width, height = _ES_HEAD.unpack_from(head)
        if major != 2 or kind != 1:
            raise ValueError(f"it is of version {major}.{minor}.{patch} and type {kind}; 2 with type 1, DVS, is read")
        self.rest = b""
        self.start, self.size = _ES_HEAD.size, (width, height)
        self._t_us = np.zeros(1, np.uint64)

    def decode(self, data: bytes) -> Events:
        """Return (n,) EVENT of any next bytes, rows from the top; those above it are counted down from 65535."""
        data = self.rest + data
        fields = [np.zeros(len(data) // 5, dtype) for dtype in ("u8", "u2", "u2", "u1")]
        count, end = _read_event_stream(np.frombuffer(data, np.uint8), self._t_us, *fields)
        self.rest = data[end:]
        t, x, y, on = (values[:count] for values in fields)
        return make_events(t, x, np.uint16(max(0, self.size[1] - 1)) - y, on)


@entry_of(__name__)
def _read_event_stream(
    data: Bytes, t_us: npt.NDArray[np.uint64], t: npt.NDArray[np.uint64], x: UInt16s,
    y: UInt16s, on: Bytes,
) -> tuple[int, int]:  # fmt: skip
    """Write the events of (n,) octets; return their number, and the octets that they take. `t_us`: (1,), the time."""
    count = at = 0
    while at < len(data):
        octet = data[at]
        if octet >= 0xFE:
            t_us[0] += np.uint64(127 if octet == 0xFF else 0)
            at += 1
            continue
        if at + 5 > len(data):
            break
        t_us[0] += np.uint64(octet >> 1)
        t[count] = t_us[0]
        x[count] = data[at + 1] | data[at + 2] << 8
        y[count] = data[at + 3] | data[at + 4] << 8
        on[count] = octet & 1
        count += 1
        at += 5
    return count, at
