"""AEDAT 2.0 and AEDAT 3.1, as bytes.

AEDAT 2.0, jAER's format for a DAVIS: text lines, then records of 8 bytes, big-endian: address, signed time in us.

    address, bit 31 = 0:   30..22 y   21..12 x   11 polarity (1 = ON)   10 external event   9..0 zero, or pin edge
    address, bit 31 = 1:   frames and samples of the inertial unit, see below

jAER counts columns from the right and rows from the bottom: x = width - 1 - column, y = height - 1 - row. The 32 bits
of time wrap to negative after 2147 s; readers count that, and a file that begins with a negative time is from after it.
A DVS128 has addresses of 16 bits: 15 external event   14..8 y   7..1 x   0 polarity (0 = ON).

AEDAT 3.1, the format of cAER: text lines, then packets of events of one kind, little-endian.

    i16 kind   i16 source   i32 event size   i32 offset of the time   i32 wraps of 2^31 us
    i32 capacity   i32 number   i32 valid ones   then the events:
    0 special   u32: bit 0 valid, 7..1 kind, 31..8 data    i32 us
    1 polarity  u32: bit 0 valid, 1 ON, 16..2 y, 31..17 x   i32 us
    2 frame     u32: bit 0 valid, 3..1 channels             i32 us of start, end, exposure start, exposure end
                i32 columns, rows, first column, first row  u16 pixels, of 16 bits
    3 IMU 6     u32: bit 0 valid   i32 us   f32 acceleration x, y, z, g; turning x, y, z, deg/s; degrees Celsius

Row 0 is the top row. Other kinds and frames with colours are left out.

Frames and samples of an inertial unit as records of AEDAT 2.0:

    address of a read of a pixel:   31 = 1   30..22 y   21..12 x   11..10 read: 0 reset, 1 signal   9..0 ADC value
    address of a sample's value:    31 = 1   30..28 index   27..12 the value, signed   11..10 = 3   9..0 zero

A sample is seven records in a row: acceleration x, y, z (8192 a g), temperature (340 a degree, from 35 degrees on),
rate of turning x, y, z (65.5 a degree per second). A frame is the reset reads of its pixels and their signal reads; a
pixel's brightness is their difference. Its exposure begins with the last reset read, or with the first one if reset and
signal reads alternate (rolling shutter), and ends with the first signal read. Columns count from the left here, unlike
those of events, rows from the bottom.

Sources: jAER, DavisChip.java, DVS128.java, AEFileOutputStream.java, IMUSample.java, DavisBaseCamera.java; v2e,
aedat2_output.py; docs.inivation.com, "AEDAT 2.0", "AEDAT 3.1"; libcaer, events/*.h.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import EdgeKind, Edges, Events, empty_edges, make_edges, make_events
from firmware_protocol.frames import brightness
from firmware_protocol.recordings.part import IMU, Frame, ImuRecords, Part, ten_bits

CHIPS: Mapping[tuple[int, int], str] = {
    (346, 260): "eu.seebetter.ini.chips.davis.Davis346blue",
    (240, 180): "eu.seebetter.ini.chips.davis.DAVIS240C",
    (640, 480): "eu.seebetter.ini.chips.davis.Davis640",
}
"""jAER's class of a chip, by (width, height)."""

_RECORD = np.dtype([("address", ">u4"), ("t", ">i4")])
_PINS = {EdgeKind.FALLING: 2, EdgeKind.RISING: 3, EdgeKind.PULSE: 4}
_EXTERNAL = 1 << 10
_WRAP_US = 1 << 32
_DVS128_PX = (128, 128)
SIZES = {
    "davis346": (346, 260), "davis240": (240, 180), "davis640": (640, 480), "dvs128": _DVS128_PX,
    "tmpdiff128": _DVS128_PX,
}  # fmt: skip
"""(width, height) of sensors by a part of their names, in lower case."""
_LIKE_DAVIS = ("davis", "sbret", "of another size")  # jAER's chips with the addresses of a DAVIS, and our own line
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
    """Return the first records of a file in a form that no reader mistakes for another line of text.

    A reader that tests for the `#` of each line would skip a record that begins with that byte (rows 140 to 143 from
    the bottom). So a frame sample precedes it, of the kind that jAER no longer uses, which all readers leave out.
    """
    if records[:1] != b"#":
        return records
    return struct.pack(">I4s", _NO_SAMPLE, records[4:8]) + records


class Aedat2Head(NamedTuple):
    """Facts in a file's lines of text: offset of its records, the sensor's size, Unix time, us, or 0, and the chip."""

    start: int
    size: tuple[int, int] | None
    unix_us: int
    chip: str


def parse_aedat2_header(head: bytes) -> Aedat2Head:
    """Return the facts in the lines of text at the start of a file; of a chip jAER's class, in lower case.

    Raises ValueError if it is no AEDAT 2.0 file, if its lines do not end within `head`, or if the addresses of its chip
    are not read.
    """
    if not head.startswith(b"#!AER-DAT2"):
        raise ValueError("it is no AEDAT 2.0 file: it does not begin with #!AER-DAT2.0")
    lines = re.match(rb"(?:#[^\n]*\n)*?(?:# *End Of ASCII Header\s*?\n|(?!#))", head)
    if lines is None:
        raise ValueError("its lines of text have no end")
    written, created, named = (
        re.search(rb"(?m)^# *" + pattern + rb"\s*?$", lines[0])
        for pattern in (
            rb"width (\d{1,9}) height (\d{1,9})", rb"Creation time: System.currentTimeMillis\(\) (\d{1,15})",
            rb"AEChip: *(.{1,200}?)",
        )
    )  # fmt: skip
    chip = named[1].decode("ascii", "replace").lower() if named else ""
    if chip and not any(name in chip for name in (*SIZES, *_LIKE_DAVIS)):
        raise ValueError(f"it is an AEDAT 2.0 file of the chip {chip}; those of a DAVIS and of a DVS128 are read")
    size = next((size for name, size in SIZES.items() if name in chip), None)
    size = (int(written[1]), int(written[2])) if written else size
    return Aedat2Head(lines.end(), size, int(created[1]) * 1000 if created else 0, chip)


class Aedat2Decoder:
    """Decoder of records in pieces, of a sensor of `size` = (width, height) and a chip named as in `Aedat2Head`.

    `outside`: events beyond it so far. `rest`: bytes of a record that is not complete. `damage`: reason why nothing is
    read from some record on; empty if there is none.
    """

    def __init__(self, size: tuple[int, int], chip: str = "") -> None:
        self._size = size
        self._is_dvs128 = size == _DVS128_PX and not any(name in chip for name in _LIKE_DAVIS)
        self.rest = b""
        self._last: int | None = None
        self._wraps_us = self._count = 0
        self._imu, self._frames = ImuWords(), FrameWords(size)
        self.outside = 0
        self.damage = ""

    def decode(self, data: bytes) -> Part:
        """Return the content that the next bytes complete; they may end inside a record."""
        data = self.rest + data
        complete_bytes = len(data) & ~7
        self.rest = data[complete_bytes:]
        records = np.frombuffer(data[:complete_bytes], _RECORD)
        t = self._times(records["t"].astype(np.int64))
        address = records["address"].astype(np.int64)[: len(t)]
        address = _of_dvs128(address) if self._is_dvs128 else address
        is_other, is_edge = address >> 31 != 0, (address >> 10) & 1 != 0
        readings = np.empty(int(np.count_nonzero(is_other)), WORD)
        readings["address"], readings["t"] = address[is_other], t[is_other]
        is_imu = (readings["address"] >> 10) & 3 == 3
        return Part(
            self._events(address, t, ~is_other & ~is_edge),
            _edges(address, t, ~is_other & is_edge),
            self._imu.decode(readings[is_imu]),
            self._frames.decode(readings[~is_imu]),
        )

    def _times(self, t: np.ndarray) -> np.ndarray:
        """Return times with the wraps of the 32 bits counted, up to the first negative one; none after it."""
        if not len(t) or self.damage:
            return t[:0]
        if self._last is None:
            self._wraps_us, self._last = _WRAP_US * int(t[0] < 0), int(t[0])
        wraps = np.rint(np.diff(t, prepend=self._last) / -_WRAP_US).astype(np.int64)
        t_us = self._wraps_us + np.cumsum(_WRAP_US * wraps) + t
        self._wraps_us, self._last = int(t_us[-1] - t[-1]), int(t[-1])
        if t_us.min() < 0:
            k = int(np.argmax(t_us < 0))
            self.damage = f"it is damaged: record {self._count + k} has the time {t_us[k]} us"
            t_us = t_us[:k]
        self._count += len(t)
        times: np.ndarray = t_us
        return times

    def _events(self, address: np.ndarray, t: np.ndarray, selected: np.ndarray) -> Events:
        address, t = address[selected], t[selected]
        x = self._size[0] - 1 - ((address >> 12) & 0x3FF)
        y = self._size[1] - 1 - ((address >> 22) & 0x1FF)
        inside = (x >= 0) & (y >= 0)
        self.outside += int(np.count_nonzero(~inside))
        return make_events(t[inside], x[inside], y[inside], (address[inside] >> 11) & 1)


def _of_dvs128(address: np.ndarray) -> np.ndarray:
    """Return addresses of a DVS128 as those of a DAVIS; those of more than 16 bits become events outside."""
    x = np.where(address >> 16 == 0, (address >> 1) & 0x7F, 0x3FF)
    events = ((address >> 8) & 0x7F) << 22 | x << 12 | (~address & 1) << 11
    davis: np.ndarray = np.where(address >> 15 == 1, _EXTERNAL | _PINS[EdgeKind.PULSE], events)
    return davis


def _edges(address: np.ndarray, t: np.ndarray, selected: np.ndarray) -> Edges:
    address, t = address[selected], t[selected]
    pin = address & 0x3FF
    return make_edges(t, np.select([pin == 2, pin == 3], [EdgeKind.FALLING, EdgeKind.RISING], EdgeKind.PULSE))


_HEAD = np.dtype(
    [("kind", "<i2"), ("source", "<i2")]
    + [(name, "<i4") for name in ("event_bytes", "time_at", "wraps", "capacity", "number", "valid")]
)
_EVENT = np.dtype([("data", "<u4"), ("t", "<i4")])
_TIMES, _PLACE = ("start", "end", "exposure_start", "exposure_end"), ("columns", "rows", "left", "top")
_FRAME = np.dtype([("data", "<u4"), *((name, "<i4") for name in (*_TIMES, *_PLACE))])
_IMU_VALUES = (
    *(f"{unit}_{axis}" for unit in ("accelerometer", "gyroscope") for axis in "xyz"), "temperature",
)  # fmt: skip
_IMU = np.dtype([("data", "<u4"), ("t", "<i4"), *((name, "<f4") for name in _IMU_VALUES)])
_SPECIAL, _POLARITY, _FRAMES, _IMU6 = range(4)
_SCALE_BITS = 6  # the 10 bits of a pixel are the upper ones of 16, as in libcaer
_MOST_PACKET = 1 << 28  # bytes
_END = b"#!END-HEADER\r\n"


def aedat31_header(source: str, started: str = "1970-01-01 00:00:00 (TZ+0000)") -> bytes:
    """Return the text lines of a file of the camera `source`, such as "DAVIS346"."""
    lines = ("#!AER-DAT3.1", "#Format: RAW", f"#Source 1: {source}", f"#Start-Time: {started}")
    return "".join(f"{line}\r\n" for line in lines).encode("ascii") + _END


def encode_aedat31(events: Events, edges: Edges | None = None) -> bytes:
    """Return the packets of events (n,) EVENT and edges (m,) EDGE, each sorted."""
    edges = empty_edges() if edges is None else edges
    polarity, special = np.empty(len(events), _EVENT), np.empty(len(edges), _EVENT)
    x, y = events["x"].astype(np.uint32), events["y"].astype(np.uint32)
    polarity["data"] = (x << 17) | (y << 2) | (events["on"].astype(np.uint32) << 1) | 1
    special["data"] = (edges["kind"].astype(np.uint32) << 1) | 1
    return _packets(_SPECIAL, special, edges["t"]) + _packets(_POLARITY, polarity, events["t"])


def encode_imu(imu: ImuRecords) -> bytes:
    """Return the packets of samples (n,) IMU, sorted; their magnetometer is left out."""
    records = np.empty(len(imu), _IMU)
    records["data"] = 1
    for name in _IMU_VALUES:
        records[name] = imu[name]
    return _packets(_IMU6, records, imu["t"])


def encode_frame(frame: Frame) -> bytes:
    """Return the packet of a frame, grey; times before the clock's zero are written as zero."""
    pixels, record = ten_bits(frame) << _SCALE_BITS, np.zeros(1, _FRAME)
    wraps = max(0, frame.t_us) >> 31
    times = (frame.t_us, frame.exposure_end_us, frame.exposure_begin_us, frame.exposure_end_us)
    values = (*(min(max(0, t_us - (wraps << 31)), (1 << 31) - 1) for t_us in times), *pixels.shape[::-1], *frame.origin)
    record["data"] = 1 | 1 << 1  # valid, one channel
    for name, value in zip((*_TIMES, *_PLACE), values, strict=True):
        record[name] = value
    body = record.tobytes() + pixels.astype("<u2").tobytes()
    return _head(_FRAMES, len(body), wraps, 1) + body


def _packets(kind: int, records: np.ndarray, t: np.ndarray) -> bytes:
    """Return packets of one kind, a new one where the 31 bits of time wrap; `t`, (n,) us, goes into the records."""
    if not len(t):
        return b""
    wraps = (t >> np.uint64(31)).astype(np.int64)
    starts = np.flatnonzero(np.diff(wraps, prepend=-1))
    records["t"] = t & np.uint64(0x7FFFFFFF)
    packets = []
    for start, end in zip(starts, [*starts[1:], len(t)], strict=True):
        packets += [_head(kind, records.itemsize, int(wraps[start]), end - start), records[start:end].tobytes()]
    return b"".join(packets)


def _head(kind: int, event_bytes: int, wraps: int, number: int) -> bytes:
    return np.array([(kind, 1, event_bytes, 4, wraps, number, number, number)], _HEAD).tobytes()


def parse_aedat31_header(head: bytes) -> tuple[int, str]:
    """Return the offset of a file's packets, and the name of its first source; raises ValueError."""
    if not head.startswith(b"#!AER-DAT3.1"):
        raise ValueError("it is no AEDAT 3.1 file: it does not begin with #!AER-DAT3.1")
    end = head.find(_END)
    if end < 0:
        raise ValueError("its lines of text have no end (#!END-HEADER)")
    source = re.search(rb"#Source \d+: ([ -~]*)\r\n", head[:end])
    return end + len(_END), source[1].decode("ascii") if source else ""


class Aedat31Decoder:
    """Decoder of packets in pieces.

    `rest`: bytes after the last complete packet. `damage`: reason why nothing is read from some packet on; empty if
    there is none.
    """

    def __init__(self) -> None:
        self._packets = 0
        self.rest = b""
        self.damage = ""

    def decode(self, data: bytes) -> Part:
        """Return the content of the packets that the next bytes complete."""
        data = self.rest + data
        parts, start = [Part()], 0
        while len(data) - start >= _HEAD.itemsize and not self.damage:
            head = np.frombuffer(data, _HEAD, 1, start)[0]
            kind, number, event_bytes = (int(head[name]) for name in ("kind", "number", "event_bytes"))
            if not 0 <= kind <= 100 or number < 0 or event_bytes < 1 or number * event_bytes > _MOST_PACKET:
                claim = f"{number} events of {event_bytes} bytes"
                self.damage = f"it is damaged: packet {self._packets} is of kind {kind} with {claim}"
                break
            body_at = start + _HEAD.itemsize
            end = body_at + number * event_bytes
            if end > len(data):
                break
            parts.append((self._frames if kind == _FRAMES else self._part)(head, data[body_at:end]))
            start = end
            self._packets += 1
        self.rest = data[start:]
        events, edges, imu = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("events", "edges", "imu")
        )
        return Part(events, edges, imu, tuple(frame for part in parts for frame in part.frames))

    def _part(self, head: np.void, body: bytes) -> Part:
        """Return the records of a packet; those without a meaning here are left out."""
        kind = int(head["kind"])
        dtype = {_SPECIAL: _EVENT, _POLARITY: _EVENT, _IMU6: _IMU}.get(kind)
        if dtype is None or head["event_bytes"] != dtype.itemsize:
            return Part()
        records = np.frombuffer(body, dtype)
        records = records[records["data"] & 1 == 1]
        t = (int(head["wraps"]) << 31) + records["t"].astype(np.int64)
        sound = self._sound(t)
        records, t = records[:sound], t[:sound]
        if kind == _POLARITY:
            return Part(_events(records["data"], t))
        if kind == _IMU6:
            return Part(imu=_imu(records, t))
        kinds = (records["data"] >> 1) & 0x7F
        understood = np.isin(kinds, [int(kind) for kind in EdgeKind])
        return Part(edges=make_edges(t[understood], kinds[understood]))

    def _sound(self, t: npt.NDArray[np.int64]) -> int:
        """Return the number of records of a packet, of the times `t` (n,), before the first negative time: damage."""
        k = int(np.append(t < 0, True).argmax())
        if k < len(t):
            self.damage = f"it is damaged: record {k} of packet {self._packets} has the time {t[k]} us"
        return k

    def _frames(self, head: np.void, body: bytes) -> Part:
        size, wraps_us = int(head["event_bytes"]), int(head["wraps"]) << 31
        frames = [_frame(body[at : at + size], wraps_us) for at in range(0, len(body), size)]
        valid = [frame for frame in frames if frame is not None]
        return Part(frames=tuple(valid[: self._sound(np.array([frame.t_us for frame in valid], np.int64))]))


def _events(data: np.ndarray, t: np.ndarray) -> Events:
    return make_events(t, data >> 17, (data >> 2) & 0x7FFF, (data >> 1) & 1)


def _imu(records: np.ndarray, t: np.ndarray) -> ImuRecords:
    imu = np.zeros(len(t), IMU)
    imu["t"] = t
    for name in _IMU_VALUES:
        imu[name] = records[name]
    return imu


def _frame(body: bytes, wraps_us: int) -> Frame | None:
    """Return the frame of an event; None if it is not valid, has colours, or is larger than its bytes."""
    if len(body) < _FRAME.itemsize:
        return None
    record = np.frombuffer(body, _FRAME, 1)[0]
    rows, columns = int(record["rows"]), int(record["columns"])
    channels = int(record["data"]) >> 1 & 7
    room = (len(body) - _FRAME.itemsize) // 2
    if not record["data"] & 1 or channels > 1 or min(rows, columns) < 1 or rows * columns > room:
        return None
    pixels = np.frombuffer(body, "<u2", rows * columns, _FRAME.itemsize).reshape(rows, columns) >> _SCALE_BITS
    start, _, begin, end = (wraps_us + int(record[name]) for name in _TIMES)
    return Frame(start, begin, end, pixels.astype(np.uint16), (int(record["left"]), int(record["top"])))


WORD = np.dtype([("address", "<u4"), ("t", "<u8")], align=True)
"""An address, and its time, us, which does not wrap."""

Words = npt.NDArray[np.void]
"""An array of WORD records, shape (n,)."""

_OTHER = 1 << 31
_SAMPLE_VALUE = 3 << 10
_SIGNAL = 1 << 10
_VALUES = (
    *(f"accelerometer_{axis}" for axis in "xyz"), "temperature", *(f"gyroscope_{axis}" for axis in "xyz"),
)  # fmt: skip
_PER_UNIT = np.array([8192.0] * 3 + [340.0] + [65.5] * 3)
_OFFSET = np.array([0.0] * 3 + [35.0] + [0.0] * 3)
_RESET_DN = 1023  # of every pixel: brightness is the difference alone


def imu_words(imu: ImuRecords) -> Words:
    """Return the words of samples (n,) IMU, (7 n,) WORD; values beyond 4 g and 500 deg/s are cut."""
    if not len(imu):
        return np.empty(0, WORD)
    counts = (np.stack([imu[name] for name in _VALUES], 1) - _OFFSET) * _PER_UNIT
    raw = np.clip(np.rint(counts), -32768, 32767).astype(np.int64) & 0xFFFF
    words = np.empty(raw.size, WORD)
    words["address"] = (_OTHER | _SAMPLE_VALUE | np.arange(7) << 28 | raw << 12).ravel()
    words["t"] = np.repeat(imu["t"], 7)
    return words


def frame_words(frame: Frame, height: int) -> tuple[Words, Words]:
    """Return the words of the reset reads and of the signal reads of a frame, of a sensor with `height` rows."""
    rows, columns = frame.pixels.shape[:2]
    x = frame.origin[0] + np.arange(columns)
    y = height - 1 - frame.origin[1] - np.arange(rows)
    address = (_OTHER | y[:, None] << 22 | x << 12).ravel()
    reset, signal = np.empty(rows * columns, WORD), np.empty(rows * columns, WORD)
    reset["address"], reset["t"] = address | _RESET_DN, frame.exposure_begin_us
    signal["address"] = address | _SIGNAL | (_RESET_DN - ten_bits(frame).ravel().astype(np.int64))
    signal["t"] = frame.exposure_end_us
    return reset, signal


class ImuWords:
    """Decoder of words into samples; words that belong to no complete sample are left out."""

    def __init__(self) -> None:
        self._rest = np.empty(0, WORD)

    def decode(self, words: Words) -> ImuRecords:
        """Return the samples (n,) IMU that the next words complete."""
        words = np.concatenate([self._rest, words])
        code = (words["address"].astype(np.int64) >> 28) & 7
        starts = np.flatnonzero(code == 0)
        starts = starts[starts + 7 <= len(words)]
        complete = (code[starts[:, None] + np.arange(7)] == np.arange(7)).all(1)
        at = starts[complete][:, None] + np.arange(7)
        self._rest = words[int(at[-1, -1]) + 1 if len(at) else 0 :][-6:]
        return _samples(words[at])


def _samples(words: Words) -> ImuRecords:
    """Return the samples of words (n, 7)."""
    raw = ((words["address"].astype(np.int64) >> 12) & 0xFFFF).astype(np.uint16).view(np.int16)
    values = raw / _PER_UNIT + _OFFSET
    imu = np.zeros(len(words), IMU)
    imu["t"] = words["t"][:, 0]
    for k, name in enumerate(_VALUES):
        imu[name] = values[:, k]
    return imu


class FrameWords:
    """Decoder of words into frames, of a sensor of `size` = (width, height): whole frames or rectangles of them."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._waiting = np.empty(0, WORD)

    def decode(self, words: Words) -> tuple[Frame, ...]:
        """Return the frames that the next words complete."""
        read = (words["address"] >> 10) & 3
        return tuple(self._frames(words[read <= 1]))

    def _frames(self, words: Words) -> Iterator[Frame]:
        waiting = np.concatenate([self._waiting, words]) if len(words) else self._waiting
        while len(waiting):
            first = int(np.append(~_is_signal(waiting), True).argmax())
            waiting = waiting[first:]  # without signal reads at the start
            # A frame ends where there are as many signal reads as reset reads.
            ends = np.flatnonzero(np.cumsum(np.where(_is_signal(waiting), -1, 1)) == 0)
            if not len(ends):
                break
            frame, waiting = self._frame(waiting[: ends[0] + 1]), waiting[ends[0] + 1 :]
            if frame is not None:
                yield frame
        if len(waiting) > 4 * self._size[0] * self._size[1]:  # reads are missing
            waiting = waiting[:0]
        self._waiting = waiting

    def _frame(self, words: Words) -> Frame | None:
        """Return the frame of its words; None if these are no rectangle within the sensor."""
        address, signal = words["address"].astype(np.int64), _is_signal(words)
        x, y = (address >> 12) & 0x3FF, self._size[1] - 1 - ((address >> 22) & 0x1FF)
        left, right = int(x.min()), int(x.max())
        top, bottom = int(y.min()), int(y.max())
        shape = (bottom - top + 1, right - left + 1)
        if top < 0 or right >= self._size[0] or 2 * shape[0] * shape[1] != len(words):
            return None
        reset_dn, signal_dn = np.full(shape, -1, np.int64), np.full(shape, -1, np.int64)
        for values, selected in ((reset_dn, ~signal), (signal_dn, signal)):
            values[y[selected] - top, x[selected] - left] = address[selected] & 0x3FF
        if min(int(reset_dn.min()), int(signal_dn.min())) < 0:  # a pixel was read twice, and another one not at all
            return None
        reset_t, end_us = words["t"][~signal], int(words["t"][signal][0])
        begin_us = int(reset_t[-1] if int(reset_t[-1]) <= end_us else reset_t[0])  # global shutter, rolling shutter
        return Frame(begin_us, begin_us, end_us, brightness(reset_dn, signal_dn), (left, top))


def _is_signal(words: Words) -> npt.NDArray[np.bool_]:
    signal: npt.NDArray[np.bool_] = (words["address"] & _SIGNAL) != 0
    return signal
