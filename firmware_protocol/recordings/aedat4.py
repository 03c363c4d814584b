"""AEDAT 4.0: the structure of a file, the decoder of its packets, and the payload of a frame.

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

Payloads of other streams have one vector in their table. "EVTS": structures of 16 bytes, see `_EVENT`; "TRIG" and
"IMUS": offsets of tables, whose fields are in the order of `_TRIGGER` and `IMU`.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Bytes, EdgeKind, Int64s, make_edges, make_events
from firmware_protocol.recordings.part import IMU, Frame, Part

MAGIC = b"#!AER-DAT4.0\r\n"
_MOST_HEADER = 1 << 24
_TABLE_SLOT = 1  # of the fields of IOHE
_STREAMS = 256


class Aedat4Head:
    """The header of a file, from its first bytes; raises ValueError if they are no header, or not all of it.

    `packets_at`: offset of the packets; `table_at`: offset of the table, -1 for a file that was not finished;
    `compression` of the packets: 0 none, 1 and 2 LZ4, 3 and 4 Zstandard; `xml`: description of the streams.
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
            place = _field_at(self._data, start, 0)
            self.compression: int = struct.unpack_from("<i", self._data, place)[0] if place else 0
            place = _field_at(self._data, start, 2)
            text = place + struct.unpack_from("<I", self._data, place)[0]
            (length,) = struct.unpack_from("<I", self._data, text)
            self.xml = self._data[text + 4 : text + 4 + length] if place else b""
        except struct.error as error:
            raise ValueError("its header is damaged") from error

    def packets_end(self, size: int) -> int:
        """Return the offset after the last packet in a file of `size` bytes."""
        return self.table_at if self.packets_at <= self.table_at <= size else size

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


def aedat4_picture(t_us: int, begin_us: int, end_us: int, pixels: Bytes, origin: tuple[int, int] = (0, 0)) -> bytes:
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


_EVENT = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("on", "?"), ("zero", "V3")])
_TRIGGER = np.dtype([("t", "<i8"), ("source", "u1")])
_SAMPLE = np.dtype([("t", "<i8"), *((name, "<f4") for name in (IMU.names or ())[1:])])
_TIMES = ("t", "begin", "end", "exposure_begin", "exposure_end")
_PICTURE = np.dtype(
    [*((name, "<i8") for name in _TIMES), ("format", "u1"), *((name, "<i2") for name in ("width", "height", "x", "y"))]
)
_CHANNELS = {0: 1, 16: 3, 24: 4}  # grey, BGR, BGRA
_PIXELS_SLOT = 10
SOURCES = {EdgeKind.RISING: 1, EdgeKind.FALLING: 2, EdgeKind.PULSE: 3}
"""Sources of external triggers; others are resets, generators and marks of frames."""
KINDS = {"EVTS": "events", "FRME": "frames", "IMUS": "imu", "TRIG": "edges"}
"""Streams by the identifiers of their types."""

_Offsets = Int64s


class Aedat4Decoder:
    """Decoder of the payloads of packets; raises ValueError for a description that is none, or without events.

    Times are later than `start_us`, the Unix time of t = 0. The first stream of events is read.

    Attributes
    ----------
    head : the header.
    events : number of the stream of events.
    info : of that stream: its camera (`source`), `sizeX`, `sizeY` and others.
    kinds : type of each stream by its number, "EVTS", "FRME", "IMUS", "TRIG" or another one.
    damage : reason why a packet was not read to its end; "" where there is none.
    """

    def __init__(self, head: Aedat4Head) -> None:
        self.head = head
        try:
            root = ET.fromstring(head.xml.rstrip(b"\0"))
        except (ET.ParseError, ValueError, LookupError) as error:
            raise ValueError(f"its description is no XML: {error}") from error
        nodes = {int(node.get("name", "")): node for node in root.iterfind("./node[@name='outInfo']/node")}
        self.kinds = {k: node.findtext("./attr[@key='typeIdentifier']", "") for k, node in nodes.items()}
        events = [k for k, kind in self.kinds.items() if kind == "EVTS"]
        if not events:
            raise ValueError("it holds no stream of events")
        self.events = events[0]
        attributes = nodes[self.events].iterfind("./node[@name='info']/attr")
        self.info: Mapping[str, str] = {node.get("key", ""): node.text or "" for node in attributes}
        offset = self.info.get("tsOffset", "")
        self.start_us = int(offset) if offset.isdecimal() and len(offset) < 19 else 0
        self.damage = ""

    def decode(self, stream: int, payload: bytes) -> Part:
        """Return the content of a packet before its damage, empty for other streams; raises ValueError."""
        kind = self.kinds.get(stream)
        if kind is None:
            raise ValueError(f"a packet is of stream {stream}, which its header does not name")
        if kind not in KINDS or (kind == "EVTS" and stream != self.events):
            return Part()
        if payload[8:12] != kind.encode():
            raise ValueError(f"a packet of stream {stream} is no {kind}")
        data = np.frombuffer(payload, np.uint8)
        table = 4 + _numbers(data, np.array([4]), "<u4").astype(np.int64)
        if kind == "FRME":
            return Part(frames=self._frame(data, table))
        start, count = _vector(data, table, 0)
        if kind == "EVTS":
            records = np.frombuffer(payload, _EVENT, count, start) if count else np.zeros(0, _EVENT)
        else:
            places = start + 4 * np.arange(count)
            tables = places + _numbers(data, places, "<u4")
            records = _records(data, tables, _TRIGGER if kind == "TRIG" else _SAMPLE)
        sound = int(np.append(records["t"] < self.start_us, True).argmax())
        if sound < len(records):
            self.damage = f"it is damaged: a record has the time {int(records['t'][sound]) - self.start_us} us"
        records = records[:sound]
        t = records["t"] - self.start_us
        if kind == "EVTS":
            return Part(make_events(t, records["x"], records["y"], records["on"].view(np.uint8) > 0))
        if kind == "IMUS":
            records["t"] = t
            return Part(imu=records.astype(IMU))
        kinds = np.zeros(256, np.uint8)
        kinds[list(SOURCES.values())] = list(SOURCES)
        edges = make_edges(t, kinds[records["source"]])
        return Part(edges=edges[edges["kind"] > 0])

    def _frame(self, data: Bytes, table: _Offsets) -> tuple[Frame, ...]:
        record = _records(data, table, _PICTURE)
        t, begin, end = (int(record[name][0]) - self.start_us for name in ("t", "exposure_begin", "exposure_end"))
        width, height, x, y = (int(record[name][0]) for name in ("width", "height", "x", "y"))
        channels = _CHANNELS.get(int(record["format"][0]), 0)
        start, count = _vector(data, table, _PIXELS_SLOT)
        if not channels or min(width, height) < 0 or count not in (0, width * height * channels):
            raise ValueError(f"a frame has {width} x {height} pixels of format {record['format'][0]}")
        pixels = data[start : start + count] if count else np.zeros(width * height * channels, np.uint8)
        shape = (height, width) if channels == 1 else (height, width, channels)
        pixels = pixels.reshape(shape)
        if channels > 1:
            pixels = pixels[..., [2, 1, 0, 3][:channels]]
        return (Frame(t, begin, end, pixels, (x, y)),)


def _vector(data: Bytes, table: _Offsets, slot: int) -> tuple[int, int]:
    """Return the place of the first element of the vector in a field of a table, (1,), and their number."""
    place = _places(data, table, slot)
    if not place[0]:
        return 0, 0
    start = place + _numbers(data, place, "<u4")
    return int(start[0]) + 4, int(_numbers(data, start, "<u4")[0])


def _records(data: Bytes, tables: _Offsets, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return the records of tables at (n,) offsets, field k of `dtype` from their slot k; 0 where it is missing."""
    records = np.zeros(len(tables), dtype)
    for slot, name in enumerate(dtype.names or ()):
        places = _places(data, tables, slot)
        records[name][places > 0] = _numbers(data, places[places > 0], dtype[name])
    return records


def _places(data: Bytes, tables: _Offsets, slot: int) -> _Offsets:
    """Return the places of a field of tables at (n,) offsets; 0 where it is missing."""
    layouts = tables - _numbers(data, tables, "<i4")
    is_there = _numbers(data, layouts, "<u2") >= 6 + 2 * slot
    offsets = np.zeros(len(tables), np.int64)
    offsets[is_there] = _numbers(data, layouts[is_there] + 4 + 2 * slot, "<u2")
    return np.where(offsets > 0, tables + offsets, 0)


def _numbers(data: Bytes, places: _Offsets, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Return the numbers at (n,) offsets; raises ValueError for an offset outside."""
    size = np.dtype(dtype).itemsize
    if len(places) and (places.min() < 0 or places.max() > len(data) - size):
        raise ValueError("a packet has a place outside of it")
    numbers: npt.NDArray[Any] = data[places[:, None] + np.arange(size)].view(dtype)[:, 0]
    return numbers
