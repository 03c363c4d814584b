"""Bytes to blocks: the decoder that the tests and the receivers use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from firmware_protocol.edges import EdgeKind, Edges, empty_edges
from firmware_protocol.events import Events, empty_events
from firmware_protocol.telemetry.layout import HEADER_BYTES, LONGEST_US, BlockError, Header, Mode

__all__ = ["Block", "as_received", "decode_block"]

_EDGE = np.dtype([("t", ">u4"), ("kind", "u1"), ("channel", "u1"), ("seq", ">u2")])


@dataclass(frozen=True)
class Block:
    """A decoded block: `events` (n,) EVENT or `edges` (n,) EDGE, the other one empty, with full times in us."""

    header: Header
    events: Events
    edges: Edges

    @property
    def mode(self) -> Mode:
        """How the block was coded."""
        return self.header.mode

    @property
    def tick_us(self) -> int:
        """The unit of its times."""
        return self.header.tick_us

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the sensor."""
        return self.header.size

    @property
    def dropped(self) -> int:
        """Events that the sender dropped between the block before and this one; 65535 stands for that many or more."""
        return self.header.dropped


def decode_block(data: bytes, near_us: int = 0) -> Block:
    """Decode one block.

    Parameters
    ----------
    data
        The block, exactly.
    near_us
        A time within 35 minutes of the block's; its upper bits complete the block's 32.

    Raises
    ------
    BlockError
        It is malformed in any way; nothing of it may be used.
    """
    header = Header.parse(data)
    start_us = _nearest(header.t_base, near_us)
    payload = np.frombuffer(data, np.uint8, offset=HEADER_BYTES)
    if header.mode == Mode.EDGE:
        return Block(header, empty_events(), _edges(header, payload, start_us))
    if header.mode == Mode.FLAT:
        return Block(header, _flat(header, payload, start_us), empty_edges())
    raise BlockError(f"mode {header.mode.name} is not decoded")


def as_received(events: Events, tick_us: int) -> Events:
    """Return what a receiver gets of a block of `events` (n,) EVENT: times cut to the tick, raster order inside."""
    received = events.copy()
    received["t"] -= received["t"] % np.uint64(tick_us)
    return received[np.lexsort((received["x"], received["y"], received["t"]))]


def _nearest(low_us: int, near_us: int) -> int:
    """Return the time that ends in the 32 bits `low_us` and is nearest to `near_us`, and not negative."""
    half = 1 << 31
    time_us = near_us - half + (low_us - near_us + half) % (1 << 32)
    return time_us if time_us >= 0 else time_us + (1 << 32)


def _records(payload: np.ndarray[tuple[int], np.dtype[np.uint8]], layout: np.dtype[np.void], count: int) -> Events:
    if len(payload) != count * layout.itemsize:
        raise BlockError(f"{count} records of {layout.itemsize} bytes are announced, {len(payload)} bytes are there")
    return payload.view(layout)


def _rising(times_us: np.ndarray[tuple[int], np.dtype[np.int64]]) -> bool:
    """Whether times (n,), us since t_base, start at 0, do not go back and end in time."""
    if not len(times_us):
        return True
    return bool(times_us[0] == 0 and times_us[-1] <= LONGEST_US and (np.diff(times_us) >= 0).all())


def _edges(header: Header, payload: np.ndarray[tuple[int], np.dtype[np.uint8]], start_us: int) -> Edges:
    records = _records(payload, _EDGE, header.count)
    since_us = records["t"].astype(np.int64)
    if not _rising(since_us) or not np.isin(records["kind"], list(EdgeKind)).all():
        raise BlockError("an edge of unknown kind, or out of its time")
    edges = empty_edges(header.count)
    edges["t"] = start_us + since_us
    for name in ("kind", "channel", "seq"):
        edges[name] = records[name]
    return edges


def _flat(header: Header, payload: np.ndarray[tuple[int], np.dtype[np.uint8]], start_us: int) -> Events:
    words = _records(payload, np.dtype([("word", ">u4")]), header.count)["word"].astype(np.int64)
    (width, height), (bx, by) = header.size, ((side - 1).bit_length() for side in header.size)
    x, y, ticks = words >> 1 & (1 << bx) - 1, words >> 1 + bx & (1 << by) - 1, words >> 1 + bx + by
    key = ticks * (width * height) + y * width + x
    if not _rising(ticks * header.tick_us) or (np.diff(key) < 0).any() or (x >= width).any() or (y >= height).any():
        raise BlockError("an event outside the array, or out of its order")
    events = empty_events(header.count)
    events["t"] = start_us + ticks * header.tick_us
    events["x"], events["y"], events["on"] = x, y, words & 1
    return events
