"""Events to blocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from firmware_protocol.edges import EdgeKind, Edges
from firmware_protocol.events import Events
from firmware_protocol.telemetry.blocks import as_received
from firmware_protocol.telemetry.layout import (
    HEADER_BYTES,
    LONGEST_US,
    MAX_COUNT,
    MAX_SIDE,
    TICKS_US,
    Header,
    Mode,
    Polarity,
)

__all__ = ["BlockEncoder", "BlockSettings"]

_LEAST_BYTES = 32
_MOST_BYTES = 65535


@dataclass(frozen=True)
class BlockSettings:
    """How blocks are made: the unit of time, the coding, and how large a block may get."""

    tick_us: int = 1
    mode: Literal["smallest", "flat", "rows", "bitmap"] = "smallest"
    max_events: int = 2048
    max_bytes: int = 1024

    def __post_init__(self) -> None:
        if self.tick_us not in TICKS_US:
            raise ValueError(f"tick_us = {self.tick_us}: a block counts ticks of 1, 10, 100 or 1000 us")
        if self.mode not in ("smallest", "flat", "rows", "bitmap"):
            raise ValueError(f'mode = "{self.mode}": choose "smallest", "flat", "rows" or "bitmap"')
        if not 1 <= self.max_events <= MAX_COUNT:
            raise ValueError(f"max_events = {self.max_events}: a block holds 1 to {MAX_COUNT} events")
        if not _LEAST_BYTES <= self.max_bytes <= _MOST_BYTES:
            raise ValueError(f"max_bytes = {self.max_bytes}: a block may have {_LEAST_BYTES} to {_MOST_BYTES} bytes")


class BlockEncoder:
    """Makes blocks of a sensor of `size` = (width, height). Holds nothing between blocks but its settings."""

    def __init__(self, size: tuple[int, int], settings: BlockSettings | None = None) -> None:
        if not all(1 <= side <= MAX_SIDE for side in size):
            raise ValueError(f"size = {size}: blocks carry sensors of 1 to {MAX_SIDE} pixels a side")
        self.size = size
        self.settings = settings or BlockSettings()

    @property
    def max_edges(self) -> int:
        """How many edges a block of the set size holds."""
        return (self.settings.max_bytes - HEADER_BYTES) // 8

    def encode(self, events: Events, dropped: int = 0) -> tuple[bytes, int]:
        """Make one block from the head of `events`.

        Parameters
        ----------
        events
            (n,) EVENT, sorted by time, in device time. None at all gives a block that only tells `dropped`.
        dropped
            How many events were dropped since the block before; what is above 65535 is told as that.

        Returns
        -------
        block
            Its bytes.
        taken
            How many events it holds: the first `taken` ones.

        Raises
        ------
        ValueError
            The first events go back in time or lie outside the sensor.
        """
        taken = self._fitting(events)
        head = as_received(events[:taken], self.settings.tick_us)
        base = int(head["t"][0]) if taken else 0
        header = Header(
            Mode.FLAT,
            self.settings.tick_us,
            Polarity.EACH,
            taken,
            base & 0xFFFFFFFF,
            min(dropped, MAX_COUNT),
            self.size,
        )
        bx, by = ((side - 1).bit_length() for side in self.size)
        ticks = (head["t"].astype(np.int64) - base) // self.settings.tick_us
        words = (
            ticks << by + bx + 1 | head["y"].astype(np.int64) << bx + 1 | head["x"].astype(np.int64) << 1 | head["on"]
        )
        return header.pack() + words.astype(">u4").tobytes(), taken

    def _fitting(self, events: Events) -> int:
        bits = 31 - sum((side - 1).bit_length() for side in self.size)
        head = events[: min(self.settings.max_events, (self.settings.max_bytes - HEADER_BYTES) // 4)]
        times = head["t"].astype(np.int64)
        if (head["x"] >= self.size[0]).any() or (head["y"] >= self.size[1]).any() or (np.diff(times) < 0).any():
            raise ValueError(f"events lie outside the sensor of {self.size} or go back in time")
        ticks = times // self.settings.tick_us
        return int(np.searchsorted(ticks, ticks[0] + (1 << bits))) if len(ticks) else 0

    def encode_edges(self, edges: Edges, dropped: int = 0) -> bytes:
        """Make one block of all `edges`, (n,) EDGE sorted by time; raises ValueError if they do not fit one."""
        if not 1 <= len(edges) <= self.max_edges:
            raise ValueError(
                f"{len(edges)} edges: a block of {self.settings.max_bytes} bytes holds 1 to {self.max_edges}"
            )
        times = edges["t"].astype(np.int64)
        since_us = times - times[0]
        if (np.diff(times) < 0).any() or since_us[-1] > LONGEST_US or not np.isin(edges["kind"], list(EdgeKind)).all():
            raise ValueError("edges go back in time, span more than 35 minutes, or are of unknown kind")
        header = Header(
            Mode.EDGE, 1, Polarity.EACH, len(edges), int(times[0]) & 0xFFFFFFFF, min(dropped, MAX_COUNT), self.size
        )
        records = np.empty(len(edges), [("t", ">u4"), ("kind", "u1"), ("channel", "u1"), ("seq", ">u2")])
        records["t"] = since_us
        for name in ("kind", "channel", "seq"):
            records[name] = edges[name]
        return header.pack() + records.tobytes()
