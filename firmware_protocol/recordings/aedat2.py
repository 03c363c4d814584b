"""AEDAT 2.0, jAER's format for a DAVIS: text lines, then records of 8 bytes, big-endian: address, signed time in us.

    address, bit 31 = 0:   30..22 y   21..12 x   11 polarity (1 = ON)   10 external event   9..0 zero, or pin edge
    address, bit 31 = 1:   frames and samples of the inertial unit, see `aedat2_readings`

jAER counts columns from the right and rows from the bottom: x = width - 1 - column, y = height - 1 - row. The 32 bits
of time wrap to negative after 2147 s; readers count that.

Sources: jAER, DavisChip.java and AEFileOutputStream.java; v2e, aedat2_output.py.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence

import numpy as np

from firmware_protocol.edges import EDGE, EdgeKind, Edges, empty_edges
from firmware_protocol.events import EVENT, Events
from firmware_protocol.recordings.aedat2_readings import WORD, FrameWords, ImuWords, Words
from firmware_protocol.recordings.part import Part

__all__ = [
    "CHIPS", "Aedat2Decoder", "aedat2_header", "edge_words", "encode_aedat2", "event_words",
    "guarded_start", "packed", "parse_aedat2_header",
]  # fmt: skip

CHIPS: Mapping[tuple[int, int], str] = {
    (346, 260): "eu.seebetter.ini.chips.davis.Davis346blue",
    (240, 180): "eu.seebetter.ini.chips.davis.DAVIS240C",
    (640, 480): "eu.seebetter.ini.chips.davis.Davis640",
}
"""jAER's class of a chip, by (width, height)."""

LIMIT_PX = (1 << 10, 1 << 9)
_RECORD = np.dtype([("address", ">u4"), ("t", ">i4")])
_PINS = {EdgeKind.FALLING: 2, EdgeKind.RISING: 3, EdgeKind.PULSE: 4}
_EXTERNAL = 1 << 10
_WRAP_US = 1 << 32
_NAMES = {b"davis346": (346, 260), b"davis240": (240, 180), b"davis640": (640, 480)}
_NO_SAMPLE = 0x8000_0800  # bit 31, read cycle 2


def aedat2_header(size: tuple[int, int], unix_us: int = 0) -> bytes:
    """Return the text lines of a file from a sensor of `size` = (width, height), whose t = 0 is at that Unix time."""
    lines = [
        "!AER-DAT2.0",
        " This is a raw AE data file - do not edit",
        " Data format is int32 address, int32 timestamp (8 bytes total), repeated for each event",
        " Timestamps tick is 1 us",
        *([f" Creation time: System.currentTimeMillis() {unix_us // 1000}"] if unix_us else []),
        f" AEChip: {CHIPS.get(size, 'of another size')}",
        f" width {size[0]} height {size[1]}",
        "End Of ASCII Header",
    ]
    return "".join(f"#{line}\r\n" for line in lines).encode("ascii")


def event_words(events: Events, size: tuple[int, int]) -> Words:
    """Return events (n,) EVENT of a sensor of `size`, (n,) WORD."""
    words = np.empty(len(events), WORD)
    x, y = np.uint32(size[0] - 1) - events["x"], np.uint32(size[1] - 1) - events["y"]
    words["address"] = (y << np.uint32(22)) | (x << np.uint32(12)) | (events["on"].astype(np.uint32) << np.uint32(11))
    words["t"] = events["t"]
    return words


def edge_words(edges: Edges) -> Words:
    """Return edges (n,) EDGE, (n,) WORD."""
    words = np.empty(len(edges), WORD)
    pins = np.array([0, 0, *(_PINS[kind] for kind in (EdgeKind.RISING, EdgeKind.FALLING, EdgeKind.PULSE))])
    words["address"], words["t"] = _EXTERNAL | pins[edges["kind"]], edges["t"]
    return words


def packed(parts: Sequence[Words]) -> bytes:
    """Return the records of words, each part sorted, in the order of time; at one time, in the order of the parts."""
    filled = [part for part in parts if len(part)]
    words = np.concatenate([np.empty(0, WORD), *filled])
    if len(filled) > 1:
        words = words[np.argsort(words["t"], kind="stable")]
    records = np.empty(len(words), _RECORD)
    records["address"], records["t"] = words["address"], words["t"].astype(np.uint32).astype(np.int32)  # wraps
    return records.tobytes()


def encode_aedat2(events: Events, size: tuple[int, int], edges: Edges | None = None) -> bytes:
    """Return the records of events (n,) EVENT and edges (m,) EDGE, each sorted, of a sensor of `size`."""
    return packed([edge_words(empty_edges() if edges is None else edges), event_words(events, size)])


def guarded_start(records: bytes) -> bytes:
    """Return the first records of a file so that no reader takes them for one more line of text.

    A reader that goes by the `#` of each line would swallow a record that begins with that byte (rows 140 to 143 from
    the bottom). Before it stands a frame sample of the kind that jAER no longer uses, which all readers leave out.
    """
    if records[:1] != b"#":
        return records
    return struct.pack(">I4s", _NO_SAMPLE, records[4:8]) + records


def parse_aedat2_header(head: bytes) -> tuple[int, tuple[int, int] | None, int]:
    """Return where the records of a file begin, the sensor's size where its lines tell it, and the Unix time, us, or 0.

    Raises ValueError for what is no AEDAT 2.0 file, or has no end of its lines within `head`.
    """
    if not head.startswith(b"#!AER-DAT2"):
        raise ValueError("it is no AEDAT 2.0 file: it does not begin with #!AER-DAT2.0")
    start, size, unix_us = 0, None, 0
    while head[start : start + 1] == b"#":
        end = head.find(b"\n", start)
        if end < 0:
            raise ValueError("its lines of text have no end")
        line = head[start + 1 : end].strip()
        size, start = _size_of(line) or size, end + 1
        told = re.match(rb"Creation time: System.currentTimeMillis\(\) (\d{1,15})$", line)
        unix_us = int(told[1]) * 1000 if told else unix_us
        if line == b"End Of ASCII Header":
            break
    return start, size, unix_us


def _size_of(line: bytes) -> tuple[int, int] | None:
    words = line.split()
    if len(words) == 4 and words[0] == b"width" and words[2] == b"height":
        return (int(words[1]), int(words[3])) if words[1].isdigit() and words[3].isdigit() else None
    if not line.startswith(b"AEChip"):
        return None
    return next((size for name, size in _NAMES.items() if name in line.lower()), None)


class Aedat2Decoder:
    """Reads records piece by piece, of a sensor of `size` = (width, height); counts what it leaves out.

    Attributes
    ----------
    outside : events beyond the sensor so far.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._rest = b""
        self._wraps_us = 0
        self._last = 0
        self._imu, self._frames = ImuWords(), FrameWords(size)
        self.outside = 0

    @property
    def others(self) -> int:
        """Records so far that belong to no whole sample or frame; those of the last ones may still wait for more."""
        return self._imu.others + self._frames.others

    def decode(self, data: bytes) -> Part:
        """Return what is complete with the next bytes, which may end inside a record."""
        data = self._rest + data
        whole = len(data) & ~7
        self._rest = data[whole:]
        records = np.frombuffer(data[:whole], _RECORD)
        address, t = records["address"].astype(np.int64), self._times(records["t"].astype(np.int64))
        is_other, is_edge = address >> 31 != 0, (address >> 10) & 1 != 0
        others = np.empty(int(np.count_nonzero(is_other)), WORD)
        others["address"], others["t"] = address[is_other], t[is_other]
        is_imu = (others["address"] >> 10) & 3 == 3
        return Part(
            self._events(address, t, ~is_other & ~is_edge),
            _edges(address, t, ~is_other & is_edge),
            self._imu.decode(others[is_imu]),
            self._frames.decode(others[~is_imu]),
        )

    def _times(self, t: np.ndarray) -> np.ndarray:
        """Return times that count the wraps of the 32 bits."""
        steps = np.diff(t, prepend=self._last)
        t_us = self._wraps_us + np.cumsum(_WRAP_US * (steps < -_WRAP_US // 2)) + t
        if len(t):
            self._wraps_us, self._last = int(t_us[-1] - t[-1]), int(t[-1])
        times: np.ndarray = np.maximum(t_us, 0)
        return times

    def _events(self, address: np.ndarray, t: np.ndarray, which: np.ndarray) -> Events:
        address, t = address[which], t[which]
        x = self._size[0] - 1 - ((address >> 12) & 0x3FF)
        y = self._size[1] - 1 - ((address >> 22) & 0x1FF)
        inside = (x >= 0) & (y >= 0)
        self.outside += int(np.count_nonzero(~inside))
        events = np.zeros(int(np.count_nonzero(inside)), EVENT)
        events["t"], events["x"], events["y"] = t[inside], x[inside], y[inside]
        events["on"] = (address[inside] >> 11) & 1
        return events


def _edges(address: np.ndarray, t: np.ndarray, which: np.ndarray) -> Edges:
    address, t = address[which], t[which]
    edges = np.zeros(len(t), EDGE)
    edges["t"] = t
    pin = address & 0x3FF
    edges["kind"] = np.select([pin == 2, pin == 3], [EdgeKind.FALLING, EdgeKind.RISING], EdgeKind.PULSE)
    return edges
