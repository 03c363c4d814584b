"""The camera's data path after the gate: encoder, FIFO, device time, and the fate of every event, mark and block.

The FIFO holds words that wait for the host, with the events that they will complete. Its size is given in bytes of
words. When it is full, the newest events, marks and blocks are dropped, always complete ones, so that its content is a
valid stream. The last 64 words are reserved for wraps: if the host stalls for up to 2 s, wraps still enter one by one,
as neuromorphic_drivers needs them. One more word beyond the size is reserved for a timestamp reset, which always
enters.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from firmware_protocol.davis346.blocks import Block, Marks, edges_of, no_marks
from firmware_protocol.davis346.words import (
    SINGLE_WRAPS,
    WRAP_BITS,
    Encoded,
    Special,
    WordEncoder,
    Words,
    WordState,
    is_column,
    is_mark,
    is_row,
)
from firmware_protocol.device.fates import Fates
from firmware_protocol.device.items import Reading, ReadingKind
from firmware_protocol.events import Events, empty_events, join_events
from firmware_protocol.usb.device import Transfer

__all__ = ["Batch", "EventStream", "Fifo", "Flushed", "Taken"]


_MIN_BYTES = 1024
_WRAP_RESERVE_WORDS = 64


@dataclass(frozen=True)
class Batch:
    """Words that enter the FIFO, the events, marks and blocks they complete, and a reader's state before them.

    `epoch_us` is the stream time at which device time is zero for these words.
    """

    encoded: Encoded
    events: Events
    before: WordState
    epoch_us: int
    marks: Marks = field(default_factory=no_marks)
    blocks: Sequence[Block] = ()

    @property
    def is_reset(self) -> bool:
        """True for a timestamp reset, which stands alone."""
        words = self.encoded.words
        return len(words) == 1 and int(words[0]) == Special.TIMESTAMP_RESET


@dataclass
class _Chunk:
    """A batch in the queue, or the front of one; `words_taken` and the other counts have left."""

    batch: Batch
    words: Words
    events: Events
    marks: Marks
    blocks: Sequence[Block] = ()
    words_taken: int = 0
    events_taken: int = 0
    marks_taken: int = 0
    blocks_taken: int = 0

    def take(self, max_words: int) -> tuple[Words, Events, Marks, Sequence[Block]]:
        """Remove up to `max_words` words; return them and the events, marks and blocks they complete."""
        words = self.words[self.words_taken : self.words_taken + max_words]
        self.words_taken += len(words)
        events, marks = self.events[self.events_taken :], self.marks[self.marks_taken :]
        if self.words_taken < len(self.words):
            events = events[: np.count_nonzero(is_column(words))]
            marks = marks[: np.count_nonzero(is_mark(words))] if len(marks) else marks
        self.events_taken += len(events)
        self.marks_taken += len(marks)
        blocks = self.blocks[self.blocks_taken : self.batch.encoded.blocks_in(self.words_taken)] if self.blocks else ()
        self.blocks_taken += len(blocks)
        return words, events, marks, blocks


@dataclass(frozen=True)
class Taken:
    """Content that left the FIFO: bytes, the events, marks and readings they complete, and their common epoch."""

    data: bytes
    events: Events
    marks: Marks
    epoch_us: int
    readings: tuple[Reading, ...] = ()


@dataclass(frozen=True)
class Flushed:
    """Content that a flush dropped: events, marks, readings by kind, a reset if there was one, and the reader's state.

    `reader_state` is None if nothing was queued.
    """

    events: int
    marks: int
    reset: bool
    reader_state: WordState | None
    readings: Counter[ReadingKind]


class Fifo:
    """A bounded queue of words.

    Parameters
    ----------
    capacity_bytes
        Size; at least 1024.
    """

    def __init__(self, capacity_bytes: int) -> None:
        if capacity_bytes < _MIN_BYTES:
            raise ValueError(f"a FIFO of {capacity_bytes} bytes is too small; give it at least {_MIN_BYTES}")
        self._capacity = capacity_bytes // 2
        self._used = 0
        self._events = self._marks = 0
        self._blocks: Counter[ReadingKind] = Counter()
        self._chunks: deque[_Chunk] = deque()

    @property
    def free_words(self) -> int:
        """Free room for words of events."""
        return max(0, self.free_wrap_words - _WRAP_RESERVE_WORDS)

    @property
    def free_wrap_words(self) -> int:
        """Free room for wrap words."""
        return max(0, self._capacity - self._used)

    @property
    def queued_events(self) -> int:
        """Events whose last word has not left."""
        return self._events

    @property
    def queued_marks(self) -> int:
        """Marks whose last word has not left."""
        return self._marks

    @property
    def queued_blocks(self) -> Counter[ReadingKind]:
        """Blocks whose last word has not left, by kind."""
        return self._blocks

    def put(self, batch: Batch) -> int:
        """Append as many complete items from the front of `batch` as fit; return the number of their words."""
        words, events, marks = batch.encoded.words, batch.events, batch.marks
        if len(words) > self.free_words:
            ends = batch.encoded.ends
            fitting = int(np.searchsorted(ends, self.free_words, side="right"))
            words = words[: ends[fitting - 1]] if fitting else words[:0]
            events = events[: np.count_nonzero(is_column(words))]
            marks = marks[: np.count_nonzero(is_mark(words))]
        self._append(batch, words, events, marks)
        return len(words)

    def put_wraps(self, batch: Batch) -> None:
        """Append wraps, which the caller has limited to `free_wrap_words`."""
        self._append(batch, batch.encoded.words, batch.events, batch.marks)

    def put_reset(self, batch: Batch) -> None:
        """Append a timestamp reset word, even if the FIFO is full; one directly after another adds nothing."""
        if self._chunks and self._chunks[-1].batch.is_reset:
            self._chunks[-1].batch = batch
            return
        self._append(batch, batch.encoded.words, batch.events, batch.marks)

    def take(self, max_bytes: int) -> Taken | None:
        """Remove up to `max_bytes` bytes of whole words, all of one epoch; None if there are none."""
        room = max_bytes // 2
        if not self._chunks or room < 1:
            return None
        epoch_us = self._chunks[0].batch.epoch_us
        words: list[Words] = []
        events: list[Events] = []
        marks: list[Marks] = []
        readings: list[Reading] = []
        while room and self._chunks and self._chunks[0].batch.epoch_us == epoch_us:
            chunk = self._chunks[0]
            some, completed, completed_marks, blocks = chunk.take(room)
            words.append(some)
            events.append(completed)
            marks.append(completed_marks)
            readings += [block.reading for block in blocks]
            room -= len(some)
            if chunk.words_taken == len(chunk.words):
                self._chunks.popleft()
        data = b"".join(part.data for part in words)
        taken = Taken(data, join_events(events), np.concatenate(marks), epoch_us, tuple(readings))
        self._used -= len(taken.data) // 2
        self._events -= len(taken.events)
        self._marks -= len(taken.marks)
        self._blocks.subtract(reading.kind for reading in readings)
        return taken

    def flush(self) -> Flushed:
        """Drop the whole content."""
        events, marks, self._events, self._marks, self._used = self._events, self._marks, 0, 0, 0
        chunks, self._chunks = self._chunks, deque()
        reset = any(chunk.batch.is_reset for chunk in chunks)
        reader_state = chunks[0].batch.before.after(chunks[0].words[: chunks[0].words_taken]) if chunks else None
        blocks, self._blocks = self._blocks, Counter()
        return Flushed(events, marks, reset, reader_state, blocks)

    def _append(self, batch: Batch, words: Words, events: Events, marks: Marks) -> None:
        if not len(words):
            return
        self._used += len(words)
        self._events += len(events)
        self._marks += len(marks)
        blocks = batch.blocks[: batch.encoded.blocks_in(len(words))] if batch.blocks else ()
        self._blocks.update(block.reading.kind for block in blocks)
        self._chunks.append(_Chunk(batch, words, events, marks, blocks))


_WRAP_SHARE = 8
"""One in eight of the free words is reserved for wraps in the computed room for events: they may be far apart."""

_WORDS_PER_EVENT = 3


class EventStream:
    """Stream of the camera: encodes items into the FIFO, and makes transfers of the FIFO's content.

    Attributes
    ----------
    rows
        Number of row words queued so far.
    """

    def __init__(self, encoder: WordEncoder, fifo: Fifo, fates: Fates) -> None:
        self._encoder = encoder
        self._fifo = fifo
        self._epoch_us = 0
        self._fates = fates
        self.rows = 0

    @property
    def queued_events(self) -> int:
        """Events in the FIFO."""
        return self._fifo.queued_events

    @property
    def queued_edges(self) -> int:
        """Marks in the FIFO."""
        return self._fifo.queued_marks

    @property
    def queued_readings(self) -> Counter[ReadingKind]:
        """Blocks in the FIFO, by kind."""
        return self._fifo.queued_blocks

    @property
    def free_words(self) -> int:
        """Free room for words of events."""
        return self._fifo.free_words

    @property
    def epoch_us(self) -> int:
        """Stream time at which device time is zero."""
        return self._epoch_us

    @property
    def room_events(self) -> int:
        """Events that certainly fit now if none is later than `room_until_us`."""
        return self.room_beside(0)

    def room_beside(self, reserved_words: int) -> int:
        """Return the number of events that certainly fit, as `room_events`, beside `reserved_words`."""
        return max(0, (self._fifo.free_words - self._wraps_that_fit - reserved_words) // _WORDS_PER_EVENT)

    @property
    def room_until_us(self) -> int:
        """Stream time up to which single wraps fit now beside `room_events` events."""
        return self._epoch_us + ((self._encoder.state.time_us >> WRAP_BITS) + self._wraps_that_fit << WRAP_BITS)

    @property
    def _wraps_that_fit(self) -> int:
        return min(SINGLE_WRAPS, self._fifo.free_words // _WRAP_SHARE)

    def start_time(self, now_us: int) -> None:
        """Begin device time at zero for a reader in its initial state; drop the queue."""
        self._empty()
        self._epoch_us = now_us
        self._encoder.reset()

    def reset_time(self, now_us: int) -> None:
        """Begin device time at zero, with a reset word in the stream."""
        before = self._encoder.state
        words = self._encoder.reset()
        self._epoch_us = now_us
        self._fifo.put_reset(self._batch(words, before))

    def put(
        self, events: Events, marks: Marks | None = None, blocks: Sequence[Block] = ()
    ) -> tuple[Marks, Sequence[Block]]:
        """Queue `events`, (n,) EVENT, `marks`, (m,) MARK, and `blocks`, in stream time and at least one in all.

        Events that find no room are dropped and counted. Marks and blocks that find none are returned: the caller may
        offer them again, or drop and count them.
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
        fitting = encoded.words[: self._fifo.put(Batch(encoded, events, before, self._epoch_us, marks, blocks))]
        if len(fitting) < len(encoded.words):
            self._encoder.state = before.after(fitting)
            self._fates.dropped_fifo += len(events) - (self._fifo.queued_events - queued)
        self.rows += int(np.count_nonzero(is_row(fitting)))
        return marks[self._fifo.queued_marks - queued_marks :], blocks[encoded.blocks_in(len(fitting)) :]

    def advance(self, now_us: int) -> None:
        """Queue the wraps due at stream time `now_us` that fit; a later call makes up for the rest."""
        before = self._encoder.state
        words = self._encoder.advance(now_us - self._epoch_us, self._fifo.free_wrap_words)
        self._fifo.put_wraps(self._batch(words, before))

    def flush(self) -> None:
        """Drop the queue, except a timestamp reset: without it the host would misread all later times.

        The encoder goes back to what the host has read, so that the stream stays valid.
        """
        flushed = self._empty()
        if flushed.reset:
            self.reset_time(self._epoch_us)
        elif flushed.reader_state is not None:
            self._encoder.state = flushed.reader_state

    def _empty(self) -> Flushed:
        flushed = self._fifo.flush()
        self._fates.flushed += flushed.events
        self._fates.edges.flushed += flushed.marks
        for kind, count in flushed.readings.items():
            self._fates.of(kind).flushed += count
        return flushed

    def take(self, max_bytes: int) -> Transfer | None:
        """Remove up to `max_bytes`; the transfer's events count as queued until `sent` or `lost`."""
        taken = self._fifo.take(max_bytes)
        if taken is None:
            return None
        edges = edges_of(taken.marks["t"], taken.marks["code"])
        transfer = Transfer(taken.events, edges, taken.epoch_us, taken.readings, taken.data)
        self._fates.take(transfer)
        return transfer

    def sent(self, transfer: Transfer) -> None:
        """Count a transfer's events as delivered."""
        self._fates.leave(transfer, "delivered")

    def lost(self, transfer: Transfer) -> None:
        """Count a transfer's events as lost on the link."""
        self._fates.leave(transfer, "lost_on_link")

    def _batch(self, words: Words, before: WordState) -> Batch:
        return Batch(Encoded(words), empty_events(), before, self._epoch_us)
