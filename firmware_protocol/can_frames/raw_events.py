"""Raw CAN frames, each complete in itself: events in classic and in FD frames, epoch and clock frames, edges and marks.

Classic CAN: two events in eight bytes, no reassembly, lowest latency.

An events frame, one little-endian 64-bit number:

    bit    0..15    16..18   19..25   26..34  35..43  44     45..53  54..62  63
           t        seq      dt       x0      y0      on0    x1      y1      on1

    t     time of the first event, in ticks, low 16 bits
    seq   counts events frames, modulo 8
    dt    ticks from the first event to the second, 0..126; 127: there is no second event, and its bits are 0

An epoch frame gives the upper bits of these times, and the number of events so far:

    u32   bits 0..29 time in ticks, low 30 bits; bits 30..31 tick (0: 1 us, 1: 10 us, 2: 100 us, 3: 1000 us)
    u16   events sent since the start, modulo 65536
    u16   events dropped before they could be sent, modulo 65536

A clock frame carries all 64 bits of the time, in us, as a little-endian number; an epoch frame of the same time
follows. Events frames and epoch frames hold low bits of one number, the time in whole ticks, so any two of them agree.
The time of a frame is the one nearest to the time of the frame before, of whatever kind. The sender puts an epoch frame
before each event that is 2^15 ticks or more away from that time, and one every few milliseconds in any case; a clock
frame once a second, and when the time changes by a second or more.

A lost events frame loses only its own two events. The receiver detects the loss by `seq`, and gets the exact number
from the counts in the next epoch frame, which include dropped events. Eight frames lost in a row leave `seq` as it was;
only the counts show them.

Nine bits each for column and row: sensors of up to 512x512 pixels.

CAN FD: up to 19 events in 64 bytes.

    u32   time of the first event, in ticks, low 32 bits, little-endian
    u8    seq, counts events frames, modulo 256
    u8    n, cells that follow, 1 to 19
    u8    events dropped since the frame before, 255 for 255 or more
    n x   u24 little-endian: bits 0..8 x, 9..17 y, 18 on, 19..23 dt
    0..   zeros up to the next length that CAN FD has

dt counts ticks since the event before, 0 to 30; the first is 0. A cell with dt = 31 holds no event: its bits 0..18 are
ticks to add. Sensors of up to 512x512 pixels; the epoch frames above give the upper bits of time and exact counts.

Edges on a camera's external input, and its own marks, are frames with an EDGE record in eight bytes:

    u32 time in us, low 32 bits | u8 kind | u8 channel | u16 seq

Little-endian; kinds are those of `EdgeKind`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from firmware_protocol.can_frames.canopen import ObjectError
from firmware_protocol.can_frames.frame import fd_length
from firmware_protocol.events import Edges, Events, Int64s, empty_events, make_edges

TICKS_US = (1, 10, 100, 1000)
"""Ticks, us, by their code."""

RAW_LIMIT_PX = 512
"""Columns and rows that nine bits can number."""

_NO_SECOND = 127
_EPOCH = struct.Struct("<IHH")
_CLOCK = struct.Struct("<Q")


class RawError(ValueError):
    """Data that are none of these frames; the message gives the reason."""


@dataclass(frozen=True)
class Epoch:
    """Content of an epoch frame.

    Attributes
    ----------
    ticks : low 30 bits of the time, in ticks: unwrap it near the expected time (`unwrapped`).
    tick_us : tick of this time and of the events frames that follow.
    sent, dropped : events since the start, modulo 65536.
    """

    ticks: int
    tick_us: int
    sent: int
    dropped: int

    def __bytes__(self) -> bytes:
        code = TICKS_US.index(self.tick_us)
        return _EPOCH.pack((self.ticks & 0x3FFF_FFFF) | code << 30, self.sent & 0xFFFF, self.dropped & 0xFFFF)

    @classmethod
    def parse(cls, data: bytes) -> Epoch:
        """Read the eight bytes; raises RawError on any other length."""
        if len(data) != _EPOCH.size:
            raise RawError(f"an epoch frame has {_EPOCH.size} bytes, not {len(data)}")
        word, sent, dropped = _EPOCH.unpack(data)
        return cls(word & 0x3FFF_FFFF, TICKS_US[word >> 30], sent, dropped)


def pack_clock(t_us: int) -> bytes:
    """Return the data of a clock frame."""
    return _CLOCK.pack(t_us)


def unpack_clock(data: bytes) -> int:
    """Return the time of a clock frame, us; raises RawError on any other length, or a time of 2^63 us or more."""
    if len(data) != _CLOCK.size:
        raise RawError(f"a clock frame has {_CLOCK.size} bytes, not {len(data)}")
    (t_us,) = _CLOCK.unpack(data)
    if t_us >> 63:
        raise RawError(f"a clock frame contains {t_us} us, which no camera reaches")
    return int(t_us)


@dataclass(frozen=True)
class EventsFrame:
    """Content of an events frame; `events` carry the full time, in us. `dropped`: those before a frame of FD."""

    seq: int
    events: Events
    dropped: int = 0


def pack_events(events: Events, tick_us: int, seq: int) -> tuple[list[bytes], Int64s]:
    """Pack events (n,), sorted, into the data of events frames; `seq` is that of the first.

    Returns the data of each frame, and the index of its first event, shape (frames,). Raises RawError if a pixel is
    beyond nine bits.
    """
    if not len(events):
        return [], np.zeros(0, np.int64)
    if int(events["x"].max()) >= RAW_LIMIT_PX or int(events["y"].max()) >= RAW_LIMIT_PX:
        raise RawError(f"an events frame numbers {RAW_LIMIT_PX} columns and rows; send larger sensors in blocks")
    records = events.tolist()  # a link packs a few events a time: loops over numbers are faster than calls of numpy
    frames: list[bytes] = []
    first: list[int] = []
    at = 0
    while at < len(records):
        t, x, y, on = records[at]
        first.append(at)
        at += 1
        ticks = t // tick_us
        word = ticks & 0xFFFF | (seq + len(frames) & 7) << 16 | (x | y << 9 | on << 18) << 26
        dt = records[at][0] // tick_us - ticks if at < len(records) else _NO_SECOND
        if 0 <= dt < _NO_SECOND:
            _, x, y, on = records[at]
            word |= dt << 19 | (x | y << 9 | on << 18) << 45
            at += 1
        else:
            word |= _NO_SECOND << 19
        frames.append(word.to_bytes(8, "little"))
    return frames, np.array(first, np.int64)


def unpack_events(data: bytes, tick_us: int, near_us: int) -> EventsFrame:
    """Read an events frame, its time taken nearest to `near_us`; raises RawError on data that no sender makes."""
    if len(data) != 8:
        raise RawError(f"an events frame has 8 bytes, not {len(data)}")
    word = int.from_bytes(data, "little")
    ticks = unwrapped(word & 0xFFFF, 16, near_us // tick_us)
    dt = word >> 19 & 0x7F
    if dt == _NO_SECOND and word >> 45:
        raise RawError("an events frame without a second event has bits for one")
    events = empty_events(1 if dt == _NO_SECOND else 2)
    events[0] = ticks * tick_us, *_pixel(word >> 26)
    if dt != _NO_SECOND:
        events[1] = (ticks + dt) * tick_us, *_pixel(word >> 45)
    return EventsFrame(word >> 16 & 7, events)


def _pixel(bits: int) -> tuple[int, int, bool]:
    """Return x, y and on of the low 19 bits."""
    return bits & 511, bits >> 9 & 511, bool(bits >> 18 & 1)


def unwrapped(low: int, bits: int, expected: int) -> int:
    """Return the number with these low `bits` that is nearest to `expected`, and not negative."""
    span = 1 << bits
    value = expected + (low - expected + (span >> 1)) % span - (span >> 1)
    return value if value >= 0 else value + span


FD_CELLS = 19
"""Most cells in 64 bytes."""

_HEAD = struct.Struct("<IBBB")
_CELL_BYTES = 3
_SKIP = 31
_LONGEST_SKIP = (1 << 19) - 1


def pack_fd_events(events: Events, tick_us: int, seq: int, dropped: int = 0) -> list[tuple[bytes, int]]:
    """Pack events (n,), sorted, into the data of FD events frames, each with its number of events.

    `seq` is that of the first frame, which also reports the `dropped` events. Raises RawError if a pixel is beyond nine
    bits.
    """
    if not len(events):
        return []
    if int(events["x"].max()) >= RAW_LIMIT_PX or int(events["y"].max()) >= RAW_LIMIT_PX:
        raise RawError(f"an events frame numbers {RAW_LIMIT_PX} columns and rows; send larger sensors in blocks")
    records = events.tolist()
    frames: list[tuple[bytes, int]] = []
    at = 0
    while at < len(records):
        first, start = at, records[at][0] // tick_us
        body, last = bytearray(), start
        while at < len(records):
            t, x, y, on = records[at]
            gap = t // tick_us - last
            cells = (
                [x | y << 9 | on << 18 | gap << 19] if 0 <= gap < _SKIP else [gap | _SKIP << 19, x | y << 9 | on << 18]
            )
            if not 0 <= gap <= _LONGEST_SKIP or len(body) + _CELL_BYTES * len(cells) > _CELL_BYTES * FD_CELLS:
                break
            for cell in cells:
                body += cell.to_bytes(_CELL_BYTES, "little")
            last += gap
            at += 1
        head = _HEAD.pack(start & 0xFFFF_FFFF, seq + len(frames) & 0xFF, len(body) // _CELL_BYTES, min(dropped, 255))
        frames.append(((head + body).ljust(fd_length(len(head) + len(body)), b"\0"), at - first))
        dropped = 0
    return frames


def unpack_fd_events(data: bytes, tick_us: int, near_us: int) -> EventsFrame:
    """Read an FD events frame, its time taken nearest to `near_us`; raises RawError on data that no sender makes."""
    if len(data) < _HEAD.size:
        raise RawError(f"an FD events frame has at least {_HEAD.size} bytes, not {len(data)}")
    low, seq, n, dropped = _HEAD.unpack_from(data)
    end = _HEAD.size + _CELL_BYTES * n
    if not 1 <= n <= FD_CELLS or len(data) != fd_length(end) or any(data[end:]):
        raise RawError(f"an FD events frame of {len(data)} bytes cannot hold {n} cells")
    events = empty_events(n)
    t, count = unwrapped(low, 32, near_us // tick_us), 0
    for at in range(_HEAD.size, end, _CELL_BYTES):
        cell = int.from_bytes(data[at : at + _CELL_BYTES], "little")
        dt = cell >> 19
        if dt == _SKIP:
            t += cell & _LONGEST_SKIP
            continue
        t += dt
        events[count] = t * tick_us, *_pixel(cell)
        count += 1
    return EventsFrame(seq, events[:count], dropped)


_MARK = struct.Struct("<IBBH")


def pack_marks(edges: Edges) -> list[bytes]:
    """Return the data of one frame for each of edges (n,)."""
    return [_MARK.pack(int(e["t"]) & 0xFFFF_FFFF, int(e["kind"]), int(e["channel"]), int(e["seq"])) for e in edges]


def unpack_mark(data: bytes, near_us: int) -> Edges:
    """Return the edge of a frame, shape (1,), its time nearest to `near_us`; raises ObjectError."""
    if len(data) != _MARK.size:
        raise ObjectError(f"a mark has {_MARK.size} bytes, not {len(data)}")
    t, kind, channel, seq = _MARK.unpack(data)
    return make_edges(unwrapped(t, 32, near_us), kind, channel, seq)
