"""The camera's data path after the gate: encoder, FIFO, device time, and the fate of every event, mark and block."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from firmware_protocol.davis346.blocks import Block
from firmware_protocol.davis346.fifo import Batch, Fifo, Flushed
from firmware_protocol.davis346.marks import Marks, edges_of, no_marks
from firmware_protocol.davis346.reading_input import BlockFates
from firmware_protocol.davis346.words import SINGLE_WRAPS, WRAP_BITS, Encoded, WordEncoder, Words, WordState, is_row
from firmware_protocol.events import Events, empty_events
from firmware_protocol.readings import ReadingKind
from firmware_protocol.usb.device import Transfer

__all__ = ["EventStream", "MarkCounters", "StreamCounters"]

_WRAP_SHARE = 8
"""One word in eight of the free ones is for wraps when telling how much fits: events may be far apart."""

_WORDS_PER_EVENT = 3


@dataclass(frozen=True)
class StreamCounters:
    """Events that reached the stream, by fate. `queued` are in the FIFO or in a transfer without a known fate."""

    dropped_fifo: int = 0
    flushed: int = 0
    delivered: int = 0
    lost_on_link: int = 0
    queued: int = 0
    rows: int = 0

    @property
    def accepted(self) -> int:
        """Events that found room in the FIFO."""
        return self.flushed + self.delivered + self.lost_on_link + self.queued


@dataclass(frozen=True)
class MarkCounters:
    """Marks that reached the stream, by fate, as for events; `dropped_fifo` without those that were held back."""

    dropped_fifo: int = 0
    flushed: int = 0
    delivered: int = 0
    lost_on_link: int = 0
    queued: int = 0


class EventStream:
    """Words in the making: turns events into FIFO content and FIFO content into transfers."""

    def __init__(self, encoder: WordEncoder, fifo: Fifo) -> None:
        self._encoder = encoder
        self._fifo = fifo
        self._epoch_us = 0
        self._in_flight = 0
        self._dropped = self._flushed = self._delivered = self._lost = self._rows = 0
        self._marks_in_flight = 0
        self._marks_dropped = self._marks_flushed = self._marks_delivered = self._marks_lost = 0
        self._blocks = BlockFates()
        self._blocks_in_flight: Counter[ReadingKind] = Counter()

    @property
    def counters(self) -> StreamCounters:
        """The fates so far, and how many row words were queued."""
        queued = self._fifo.queued_events + self._in_flight
        return StreamCounters(self._dropped, self._flushed, self._delivered, self._lost, queued, self._rows)

    @property
    def mark_counters(self) -> MarkCounters:
        """The fates of marks so far."""
        queued = self._fifo.queued_marks + self._marks_in_flight
        return MarkCounters(self._marks_dropped, self._marks_flushed, self._marks_delivered, self._marks_lost, queued)

    @property
    def block_fates(self) -> BlockFates:
        """The fates of blocks so far."""
        return replace(self._blocks, queued=self._fifo.queued_blocks + self._blocks_in_flight)

    @property
    def free_words(self) -> int:
        """Words that fit now."""
        return self._fifo.free_words

    @property
    def epoch_us(self) -> int:
        """Stream time at which device time is zero."""
        return self._epoch_us

    @property
    def room_events(self) -> int:
        """Events that certainly fit now, if none is later than `room_until_us`."""
        return self.room_beside(0)

    def room_beside(self, reserved_words: int) -> int:
        """Return how many events certainly fit, as `room_events`, when so many words are kept for others."""
        return max(0, (self._fifo.free_words - self._wraps_that_fit - reserved_words) // _WORDS_PER_EVENT)

    @property
    def room_until_us(self) -> int:
        """Stream time up to which single wraps fit now, beside `room_events` events."""
        return self._epoch_us + ((self._encoder.state.time_us >> WRAP_BITS) + self._wraps_that_fit << WRAP_BITS)

    @property
    def _wraps_that_fit(self) -> int:
        return min(SINGLE_WRAPS, self._fifo.free_words // _WRAP_SHARE)

    def start_time(self, now_us: int) -> None:
        """Begin device time at zero, for a reader that knows nothing; what is queued is dropped."""
        self._empty()
        self._epoch_us = now_us
        self._encoder.reset()

    def reset_time(self, now_us: int) -> None:
        """Begin device time at zero, and say so in the stream."""
        before = self._encoder.state
        words = self._encoder.reset()
        self._epoch_us = now_us
        self._fifo.put_reset(self._batch(words, before))

    def put(
        self, events: Events, marks: Marks | None = None, blocks: Sequence[Block] = ()
    ) -> tuple[Marks, Sequence[Block]]:
        """Queue `events`, (n,) EVENT, `marks`, (m,) MARK, and `blocks`, in stream time and at least one in all.

        Events that find no room are dropped and counted. Marks and blocks that find none are returned: whether they are
        dropped is for the caller, who says so of marks by `drop_marks` and counts blocks.
        """
        marks = no_marks() if marks is None else marks
        at_start = self._encoder.state
        first_us = min([int(some["t"][0]) for some in (events, marks) if len(some)] + [b.t_us for b in blocks[:1]])
        wraps = self._encoder.advance(first_us - self._epoch_us, self._fifo.free_wrap_words)
        before = self._encoder.state
        try:
            encoded = self._encoder.encode(events, self._epoch_us, marks, blocks)
        except ValueError:
            self._encoder.state = at_start
            raise
        self._fifo.put_wraps(self._batch(wraps, at_start))
        queued, queued_marks = self._fifo.queued_events, self._fifo.queued_marks
        kept = encoded.words[: self._fifo.put(Batch(encoded, events, before, self._epoch_us, marks, blocks))]
        if len(kept) < len(encoded.words):
            self._encoder.state = before.after(kept)
            self._dropped += len(events) - (self._fifo.queued_events - queued)
        self._rows += int(np.count_nonzero(is_row(kept)))
        return marks[self._fifo.queued_marks - queued_marks :], blocks[encoded.blocks_in(len(kept)) :]

    def drop_marks(self, count: int) -> None:
        """Count `count` marks as dropped for want of room."""
        self._marks_dropped += count

    def advance(self, now_us: int) -> None:
        """Queue the wraps due at stream time `now_us`, as far as there is room; the rest is made up for later."""
        before = self._encoder.state
        words = self._encoder.advance(now_us - self._epoch_us, self._fifo.free_wrap_words)
        self._fifo.put_wraps(self._batch(words, before))

    def flush(self) -> None:
        """Drop what is queued, but for a timestamp reset: without it the host would misread all times to come.

        The encoder goes back to what the host has read, so that the stream stays valid.
        """
        flushed = self._empty()
        if flushed.reset:
            self.reset_time(self._epoch_us)
        elif flushed.known is not None:
            self._encoder.state = flushed.known

    def _empty(self) -> Flushed:
        flushed = self._fifo.flush()
        self._flushed += flushed.events
        self._marks_flushed += flushed.marks
        self._blocks.flushed.update(flushed.readings)
        return flushed

    def take(self, max_bytes: int) -> Transfer | None:
        """Remove up to `max_bytes`; the transfer's events count as queued until `sent` or `lost`."""
        taken = self._fifo.take(max_bytes)
        if taken is None:
            return None
        self._in_flight += len(taken.events)
        self._marks_in_flight += len(taken.marks)
        edges = edges_of(taken.marks["t"], taken.marks["code"])
        self._blocks_in_flight.update(reading.kind for reading in taken.readings)
        return Transfer(taken.data, taken.events, taken.epoch_us, edges, taken.readings)

    def sent(self, transfer: Transfer) -> None:
        """Count a transfer's events as delivered."""
        self._in_flight -= len(transfer.events)
        self._delivered += len(transfer.events)
        self._marks_in_flight -= len(transfer.edges)
        self._marks_delivered += len(transfer.edges)
        self._settle(transfer, self._blocks.delivered)

    def lost(self, transfer: Transfer) -> None:
        """Count a transfer's events as lost on the link."""
        self._in_flight -= len(transfer.events)
        self._lost += len(transfer.events)
        self._marks_in_flight -= len(transfer.edges)
        self._marks_lost += len(transfer.edges)
        self._settle(transfer, self._blocks.lost)

    def _settle(self, transfer: Transfer, fate: Counter[ReadingKind]) -> None:
        kinds = [reading.kind for reading in transfer.readings]
        self._blocks_in_flight.subtract(kinds)
        fate.update(kinds)

    def _batch(self, words: Words, before: WordState) -> Batch:
        return Batch(Encoded(words), empty_events(), before, self._epoch_us)
