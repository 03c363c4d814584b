"""Events in CAN FD frames that each stand alone: up to 19 events in 64 bytes.

    u32   time of the first event, in ticks, low 32 bits, little-endian
    u8    seq, counts events frames, modulo 256
    u8    n, cells that follow, 1 to 19
    u8    events dropped since the frame before, 255 for 255 or more
    n x   u24 little-endian: bits 0..8 x, 9..17 y, 18 on, 19..23 dt
    0..   zeros up to the next length that CAN FD has

dt counts ticks since the event before, 0 to 30; the first is 0. A cell with dt = 31 holds no event: its bits 0..18 are
ticks to add. Sensors of up to 512x512 pixels; the epoch frames of `raw_events` give the upper bits of time and exact
counts.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from firmware_protocol.can_frames.frame import fd_length
from firmware_protocol.can_frames.raw_events import RAW_LIMIT_PX, RawError, unwrapped
from firmware_protocol.events import Events, empty_events

__all__ = ["FD_CELLS", "FdEventsFrame", "pack_fd_events", "unpack_fd_events"]

FD_CELLS = 19
"""Cells that fit into 64 bytes."""

_HEAD = struct.Struct("<IBBB")
_CELL_BYTES = 3
_SKIP = 31
_LONGEST_SKIP = (1 << 19) - 1


@dataclass(frozen=True)
class FdEventsFrame:
    """What an FD events frame says; `events` carry the full time, in us."""

    seq: int
    dropped: int
    events: Events


def pack_fd_events(events: Events, tick_us: int, seq: int, dropped: int = 0) -> list[tuple[bytes, int]]:
    """Pack events (n,), sorted, into the data of FD events frames, and how many events each holds.

    `seq` is that of the first frame, which also tells of the `dropped` events. Raises RawError where a pixel lies
    beyond nine bits.
    """
    if not len(events):
        return []
    if int(events["x"].max()) >= RAW_LIMIT_PX or int(events["y"].max()) >= RAW_LIMIT_PX:
        raise RawError(f"an events frame numbers {RAW_LIMIT_PX} columns and rows; send larger sensors in blocks")
    ticks = events["t"] // np.uint64(tick_us)
    gaps = np.diff(ticks, prepend=ticks[:1]).astype(np.int64)
    cells, cell_of = _cells(events, gaps)
    raw = cells.astype("<u4").view(np.uint8).reshape(-1, 4)[:, :_CELL_BYTES].tobytes()
    frames: list[tuple[bytes, int]] = []
    first = 0
    while first < len(events):
        end = _end_of_frame(first, cell_of, gaps)
        start, stop = int(cell_of[first]), int(cell_of[end - 1]) + 1
        own = (int(cells[start]) & 0x7FFFF).to_bytes(_CELL_BYTES, "little")  # the first event's dt is 0
        head = _HEAD.pack(int(ticks[first]) & 0xFFFF_FFFF, (seq + len(frames)) & 0xFF, stop - start, min(dropped, 255))
        data = head + own + raw[_CELL_BYTES * (start + 1) : _CELL_BYTES * stop]
        frames.append((data.ljust(fd_length(len(data)), b"\0"), end - first))
        first, dropped = end, 0
    return frames


def _cells(events: Events, gaps: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.int64]]:
    """Return all events as cells, each long gap as one in front of its event, and the cell of each event."""
    long = gaps >= _SKIP
    cell_of = np.arange(len(events)) + np.cumsum(long)
    cells = np.zeros(int(cell_of[-1]) + 1, np.uint32)
    x, y, on = (events[name].astype(np.uint32) for name in ("x", "y", "on"))
    cells[cell_of] = x | y << 9 | on << 18 | np.where(long, 0, gaps).astype(np.uint32) << 19
    cells[cell_of[long] - 1] = np.minimum(gaps[long], _LONGEST_SKIP).astype(np.uint32) | _SKIP << 19
    return cells, cell_of


def _end_of_frame(first: int, cell_of: npt.NDArray[np.int64], gaps: npt.NDArray[np.int64]) -> int:
    """Return the event after the last that fits into the frame that `first` begins."""
    end = int(np.searchsorted(cell_of, cell_of[first] + FD_CELLS))
    too_far = np.flatnonzero(gaps[first + 1 : end] > _LONGEST_SKIP)
    return first + 1 + int(too_far[0]) if len(too_far) else end


def unpack_fd_events(data: bytes, tick_us: int, near_us: int) -> FdEventsFrame:
    """Read an FD events frame, its time taken nearest to `near_us`; raises RawError on what no sender makes."""
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
        record = events[count]
        record["t"], record["x"], record["y"], record["on"] = t * tick_us, cell & 511, cell >> 9 & 511, cell >> 18 & 1
        count += 1
    return FdEventsFrame(seq, dropped, events[:count])
