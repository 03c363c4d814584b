"""From queued events to numbered blocks of EVT3 words, and the selection of the events that leave the sensor.

Sent blocks are stored for a while, so that they can be sent again. Each block begins with its time and row, so that the
loss of a block does not affect others. During a silence, blocks without events carry the time: decoders lose it after
8.4 s.

The selection passes events in the ranges of rows and columns, at most as many as the rate control allows.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from firmware_protocol.device.items import Items
from firmware_protocol.events import Edges, Events, copy_events, empty_edges, empty_events, join_events
from firmware_protocol.evt.evt3 import Evt3Encoder
from firmware_protocol.gige.gvsp import BLOCK_OCTETS, Block
from firmware_protocol.gige.registers import (
    COLUMNS,
    INVERTED,
    MOST_RANGES,
    PERIOD_US,
    ROWS,
    Erc,
    RangeRegisters,
    Rule,
    evs_rules,
)
from firmware_protocol.imx636.selection import RateControl, Selected

__all__ = ["Extra", "Outflow", "Outgoing", "Selection", "before"]


_SENT_BLOCKS = 256
_MOST_EVENTS = BLOCK_OCTETS // 4  # a row and a column each; events that need more octets go into the next block
_LONGEST_US = 1_000_000  # of device time in one block: no time words are needed in between
_SILENCE_US = 1_000_000
_LONGEST_SILENCE_US = 3_600_000_000  # in one block


def before(events: Events, until_us: int) -> int:
    """Return the number of events (n,) EVENT, sorted, that are older; numpy's own search copies all times first."""
    times = events["t"]
    return bisect_left(range(len(times)), until_us, key=lambda place: int(times[place]))


@dataclass(frozen=True)
class Outgoing(Items):
    """A block, and the items in it."""

    block: Block = field(kw_only=True)


@dataclass(frozen=True)
class Extra:
    """A datagram of the stream that a host requested, with its block and packet number; block 0: none."""

    data: bytes
    block: int = 0
    number: int = 0


class Outflow:
    """Outgoing events and edges of one acquisition.

    Attributes
    ----------
    number
        Number of the last block.
    queued, edges_queued
        Events and edges that wait.
    """

    def __init__(self, epoch_us: int, block_us: int, width: int, number: int = 0) -> None:
        self._epoch_us = self._reported_us = epoch_us
        self._block_us = block_us
        self._encoder = Evt3Encoder(standalone=True, width=width, origin_us=epoch_us)
        self._waiting: deque[Events] = deque()
        self._edges = empty_edges()
        self._sent_blocks: deque[Block] = deque(maxlen=_SENT_BLOCKS)
        self.number = number
        self.queued = 0

    @property
    def edges_queued(self) -> int:
        """Edges that wait."""
        return len(self._edges)

    def put(self, events: Events) -> None:
        """Queue events (n,) EVENT, sorted; they are copied."""
        if len(events):
            self._waiting.append(copy_events(events))
            self.queued += len(events)

    def put_edges(self, edges: Edges) -> None:
        """Queue edges (n,) EDGE, sorted; one older than the time already sent gets that time."""
        together = np.concatenate([self._edges, edges])
        self._edges = together[np.argsort(together["t"], kind="stable")]

    def next(self, now_us: int, packet_size: int, *, at_once: bool = False) -> Outgoing | None:
        """Return the next block; None while it is empty, or may still grow and `at_once` is false."""
        begin_us = self._first_us()
        if begin_us is None or begin_us > now_us:
            return self._silence(now_us, packet_size)
        if begin_us - self._reported_us > _SILENCE_US:
            return self._silence(begin_us, packet_size)
        if not at_once and self.queued < _MOST_EVENTS and now_us - begin_us < self._block_us:
            return None
        return self._block(begin_us, now_us, packet_size)

    def clear(self) -> None:
        """Empty the queues."""
        self._waiting.clear()
        self._edges, self.queued = empty_edges(), 0

    def sent_block(self, number: int) -> Block | None:
        """Return a block that was sent; None if it is no longer stored, or never was."""
        return next((block for block in self._sent_blocks if block.number == number), None)

    def _first_us(self) -> int | None:
        firsts = [int(self._waiting[0]["t"][0])] if self._waiting else []
        if len(self._edges):
            firsts.append(max(int(self._edges["t"][0]), self._reported_us))
        return min(firsts, default=None)

    def _block(self, begin_us: int, now_us: int, packet_size: int) -> Outgoing:
        events = self._taken(begin_us + _LONGEST_US)
        until_us = int(events["t"][-1]) if len(events) == _MOST_EVENTS else min(now_us, begin_us + _LONGEST_US)
        due = int(np.count_nonzero(self._edges["t"] <= max(until_us, 0)))
        words, used, used_edges = self._encoder.fill(events, self._late(self._edges[:due]), BLOCK_OCTETS)
        self._put_back(events[used:])
        events, edges, self._edges = events[:used], self._edges[:used_edges], self._edges[used_edges:]
        last_us = max([int(each["t"][-1]) for each in (events, edges) if len(each)])
        self._reported_us = max(self._reported_us, last_us)
        return Outgoing(events, edges, self._epoch_us, block=self._numbered(words, begin_us, packet_size))

    def _taken(self, until_us: int) -> Events:
        """Return the events of one block: limited in number and in length of time."""
        taken, room = [], _MOST_EVENTS
        while self._waiting and room and int(self._waiting[0]["t"][0]) < until_us:
            first = self._waiting.popleft()
            count = min(room, before(first, until_us))
            if count < len(first):
                self._waiting.appendleft(first[count:])
            taken.append(first[:count])
            room -= count
        self.queued -= _MOST_EVENTS - room
        return join_events(taken) if taken else empty_events()

    def _put_back(self, events: Events) -> None:
        """Put events that found no room in a block back into the queue."""
        if len(events):
            self._waiting.appendleft(events)
            self.queued += len(events)

    def _late(self, edges: Edges) -> Edges:
        late = edges.copy()
        late["t"] = np.maximum(late["t"], np.uint64(self._reported_us))
        return late

    def _silence(self, until_us: int, packet_size: int) -> Outgoing | None:
        """Return a block that carries only the time; None if the last block is recent."""
        if until_us - self._reported_us < _SILENCE_US:
            return None
        self._reported_us = min(until_us, self._reported_us + _LONGEST_SILENCE_US)
        words = self._encoder.advance(self._reported_us - self._epoch_us)
        return Outgoing(epoch_us=self._epoch_us, block=self._numbered(words, self._reported_us, packet_size))

    def _numbered(self, words: bytes, time_us: int, packet_size: int) -> Block:
        self.number += 1
        block = Block(self.number, 1000 * (time_us - self._epoch_us), words, packet_size)
        self._sent_blocks.append(block)
        return block


_Mask = npt.NDArray[np.bool_]


class Selection:
    """Registers of ranges and of the rate control, applied to events."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._bounds = evs_rules(size)
        self._rows, self._columns = _Ranges(size[1]), _Ranges(size[0])
        self._inverted = False
        self._rate = RateControl(PERIOD_US)

    def rules(self) -> dict[int, Rule]:
        """Return the rules for writes to these registers, by address."""
        doing = self._doing(ROWS, self._rows) | self._doing(COLUMNS, self._columns)
        doing |= {
            INVERTED: self._invert,
            Erc.ON: self._rate.turn,
            Erc.PERIOD_US: self._rate.set_period_us,
            Erc.EVENTS: self._rate.set_most,
        }
        return {address: _followed(self._bounds[address], do) for address, do in doing.items()}

    def apply(self, events: Events, epoch_us: int) -> Selected:
        """Return the part that passes of events (n,) EVENT, sorted; the camera's clock was zero at `epoch_us`."""
        wanted = events
        if self._rows.on or self._columns.on:
            crossing = self._rows.mask[events["y"]] & self._columns.mask[events["x"]]
            wanted = events[~crossing if self._inverted else crossing]
        let_by = wanted[self._rate.passing(wanted, epoch_us)] if self._rate.on else wanted
        return Selected(let_by, len(events) - len(wanted), len(wanted) - len(let_by))

    def _invert(self, value: int) -> None:
        self._inverted = bool(value)

    @staticmethod
    def _doing(registers: RangeRegisters, ranges: _Ranges) -> dict[int, Callable[[int], None]]:
        return {
            registers.on: ranges.turn,
            registers.selector: ranges.select,
            registers.size: ranges.resize,
            registers.offset: ranges.move,
            registers.count: ranges.use,
        }


class _Ranges:
    """Ranges of rows, or of columns, that a host writes one by one: selector, then size and offset.

    Attributes
    ----------
    mask
        Mask of the rows or columns in a range, (pixels,) bool; true for all while the ranges are off.
    """

    def __init__(self, pixels: int) -> None:
        self._sizes = np.zeros(MOST_RANGES, np.int64)
        self._offsets = np.zeros(MOST_RANGES, np.int64)
        self._selected = self._used = 0
        self.on = False
        self.mask: _Mask = np.ones(pixels, np.bool_)

    def turn(self, on: int) -> None:
        """Switch the ranges on or off."""
        self.on = bool(on)
        self._draw()

    def select(self, number: int) -> None:
        """Select the range that is written next."""
        self._selected = number

    def resize(self, size: int) -> None:
        """Set the size of the selected range."""
        self._sizes[self._selected] = size
        self._draw()

    def move(self, offset: int) -> None:
        """Set the start of the selected range."""
        self._offsets[self._selected] = offset
        self._draw()

    def use(self, count: int) -> None:
        """Set the number of ranges, from the first on, that are used."""
        self._used = count
        self._draw()

    def _draw(self) -> None:
        self.mask[:] = not self.on
        for size, offset in zip(self._sizes[: self._used], self._offsets[: self._used], strict=True):
            self.mask[offset : offset + size] = True


def _followed(bounds: Rule, do: Callable[[int], None]) -> Rule:
    """Return a rule that calls `do` with a value that is within bounds."""

    def rule(value: int) -> int:
        done = bounds(value)
        do(done)
        return done

    return rule
