"""Events to blocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from firmware_protocol.edges import EdgeKind, Edges
from firmware_protocol.event_copies import bytes_of
from firmware_protocol.events import Events
from firmware_protocol.telemetry.layout import (
    EDGE_RECORD,
    HEADER_BYTES,
    LONGEST_US,
    MAX_COUNT,
    MAX_SIDE,
    TICKS_US,
    Header,
    Mode,
    Polarity,
)
from firmware_protocol.telemetry.ordering import BACKWARDS, OUTSIDE, form_of, new_scratch
from firmware_protocol.telemetry.writing import Limits, write_block

__all__ = ["BlockEncoder", "BlockSettings"]

_LEAST_BYTES = 32
_MOST_BYTES = 65535
_MODES = {"smallest": -1, "flat": int(Mode.FLAT), "rows": int(Mode.ROWS), "bitmap": int(Mode.BITMAP)}
_COMPLAINTS = {
    OUTSIDE: "an event lies outside the sensor of {size[0]} x {size[1]} pixels",
    BACKWARDS: "events go back in time: a block takes them sorted",
}


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
        self._form = form_of(size, self.settings.tick_us)
        self._limits = Limits(_MODES[self.settings.mode], self.settings.max_events, self.settings.max_bytes)
        self._room = new_scratch(self.settings.max_events)
        self._out = np.zeros(self.settings.max_bytes, np.uint8)

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
        if not len(events):
            return self._header(Mode.FLAT, Polarity.EACH, 0, 0, dropped), 0
        first_us = int(events["t"][0])
        head = bytes_of(events[: self.settings.max_events])
        taken, mode, polarity, size = write_block(head, self._form, self._limits, self._room, self._out)
        if taken < 0:
            raise ValueError(_COMPLAINTS[taken].format(size=self.size))
        start_us = first_us - first_us % self.settings.tick_us
        header = self._header(Mode(mode), Polarity(polarity), taken, start_us, dropped)
        return header + self._out[:size].tobytes(), taken

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
        records = np.empty(len(edges), EDGE_RECORD)
        records["t"] = since_us
        for name in ("kind", "channel", "seq"):
            records[name] = edges[name]
        return self._header(Mode.EDGE, Polarity.EACH, len(edges), int(times[0]), dropped) + records.tobytes()

    def _header(self, mode: Mode, polarity: Polarity, count: int, start_us: int, dropped: int) -> bytes:
        tick_us = 1 if mode == Mode.EDGE else self.settings.tick_us
        low = start_us & 0xFFFFFFFF
        return Header(mode, tick_us, polarity, count, low, min(dropped, MAX_COUNT), self.size).pack()
