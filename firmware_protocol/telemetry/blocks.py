"""Bytes to blocks: the decoder that the tests and the receivers use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from firmware_protocol.events import EVENT, EdgeKind, Edges, Events, empty_edges, empty_events
from firmware_protocol.telemetry.layout import EDGE_RECORD, HEADER_BYTES, LONGEST_US, BlockError, Header, Mode
from firmware_protocol.telemetry.reading import read_events

__all__ = ["Block", "as_received", "decode_block"]


@dataclass(frozen=True)
class Block:
    """A decoded block: `events` (n,) EVENT or `edges` (n,) EDGE, the other one empty, with full times in us."""

    header: Header
    events: Events
    edges: Edges

    @property
    def mode(self) -> Mode:
        """Coding of the block."""
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
        """Events that the sender dropped between the previous block and this one; 65535 means that many or more."""
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
        The block is malformed; none of its content may be used.
    """
    header = Header.parse(data)
    start_us = _nearest(header.t_base, near_us)
    if header.mode == Mode.EDGE:
        return Block(header, empty_events(), _edges(data, header, start_us))
    return Block(header, read_events(data, header, start_us), empty_edges())


def as_received(events: Events, tick_us: int) -> Events:
    """Return a block of `events` as a receiver decodes it: times rounded down to the tick, raster order in each tick.

    A sender that applies this to waiting events, before it makes blocks of them, gets smaller blocks if a tick has more
    events than a block; the events and their times are the same.

    Parameters
    ----------
    events
        (n,) EVENT, sorted by time, spanning less than 2**32 ticks.
    tick_us
        The unit of time.
    """
    if not len(events):
        return events
    ticks = events["t"] // np.uint64(tick_us)
    since = ticks - ticks[0]
    if since[-1] >> np.uint64(32):
        raise ValueError(f"events that span {since[-1]} ticks of {tick_us} us: put shorter streams in order one by one")
    key = since << np.uint64(32) | events["y"].astype(np.uint64) << np.uint64(16) | events["x"]
    order = np.argsort(key, kind="stable")
    received = events.view(f"V{EVENT.itemsize}")[order].view(EVENT)
    received["t"] = ticks[order] * np.uint64(tick_us)
    return received


def _nearest(low_us: int, near_us: int) -> int:
    """Return the time that ends in the 32 bits `low_us` and is nearest to `near_us`, and not negative."""
    half = 1 << 31
    time_us = near_us - half + (low_us - near_us + half) % (1 << 32)
    return time_us if time_us >= 0 else time_us + (1 << 32)


def _edges(data: bytes, header: Header, start_us: int) -> Edges:
    size = len(data) - HEADER_BYTES
    if size != header.count * EDGE_RECORD.itemsize:
        raise BlockError(f"{header.count} edges are announced, but {size} bytes are there")
    records = np.frombuffer(data, EDGE_RECORD, offset=HEADER_BYTES)
    since_us = records["t"].astype(np.int64)
    if since_us[0] or since_us[-1] > LONGEST_US or (np.diff(since_us) < 0).any():
        raise BlockError("edges do not start with the block, go back in time, or span more than 35 minutes")
    if not np.isin(records["kind"], list(EdgeKind)).all():
        raise BlockError("an edge is of a kind that does not exist")
    edges = empty_edges(header.count)
    edges["t"] = start_us + since_us
    for name in ("kind", "channel", "seq"):
        edges[name] = records[name]
    return edges
