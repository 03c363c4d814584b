"""The camera's FIFO: words that wait for the host, with the events that they will complete.

Its size is stated in bytes of words. When it is full, the newest events, marks and blocks are dropped, always whole
ones, so that what was taken in is a valid stream. The last 64 words are kept for wraps: through 2 s of a stalled host
they still go in one by one, as neuromorphic_drivers needs them. One word beyond the size is kept for a timestamp reset:
it always gets in.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from firmware_protocol.davis346.blocks import Block
from firmware_protocol.davis346.marks import Marks, no_marks
from firmware_protocol.davis346.words import Encoded, Special, Words, WordState, is_column, is_mark
from firmware_protocol.event_copies import join_events
from firmware_protocol.events import Events
from firmware_protocol.readings import Reading, ReadingKind

__all__ = ["Batch", "Fifo", "Flushed", "Taken"]

_MIN_BYTES = 1024
_WRAP_RESERVE_WORDS = 64


@dataclass(frozen=True)
class Batch:
    """Words that go into the FIFO, the events, marks and blocks they complete, and what a reader knows before them.

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
    """A batch in the queue, or the front of one; `words_taken` and so on have left."""

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
    """What left the FIFO: bytes, the events, marks and readings they complete, and the epoch of all of them."""

    data: bytes
    events: Events
    marks: Marks
    epoch_us: int
    readings: tuple[Reading, ...] = ()


@dataclass(frozen=True)
class Flushed:
    """What a flush dropped: events, marks, readings by kind, whether a reset was there, and what the reader knows now.

    `known` is None when nothing was queued.
    """

    events: int
    marks: int
    reset: bool
    known: WordState | None
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
        """Words of events that fit now."""
        return max(0, self.free_wrap_words - _WRAP_RESERVE_WORDS)

    @property
    def free_wrap_words(self) -> int:
        """Wrap words that fit now."""
        return max(0, self._capacity - self._used)

    @property
    def queued_events(self) -> int:
        """Events that wait for words of theirs to leave."""
        return self._events

    @property
    def queued_marks(self) -> int:
        """Marks that wait for words of theirs to leave."""
        return self._marks

    @property
    def queued_blocks(self) -> Counter[ReadingKind]:
        """Blocks that wait for words of theirs to leave, by kind."""
        return self._blocks

    def put(self, batch: Batch) -> int:
        """Take in as many whole items from the front of `batch` as fit; return their words' number."""
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
        """Take in wraps, which the caller has made to fit into `free_wrap_words`."""
        self._append(batch, batch.encoded.words, batch.events, batch.marks)

    def put_reset(self, batch: Batch) -> None:
        """Take in a timestamp reset word, also when full; one directly after another adds nothing."""
        if self._chunks and self._chunks[-1].batch.is_reset:
            self._chunks[-1].batch = batch
            return
        self._append(batch, batch.encoded.words, batch.events, batch.marks)

    def take(self, max_bytes: int) -> Taken | None:
        """Remove up to `max_bytes` bytes of whole words, all of one epoch; None when there are none."""
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
            some, completed, told, blocks = chunk.take(room)
            words.append(some)
            events.append(completed)
            marks.append(told)
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
        """Drop everything."""
        events, marks, self._events, self._marks, self._used = self._events, self._marks, 0, 0, 0
        chunks, self._chunks = self._chunks, deque()
        reset = any(chunk.batch.is_reset for chunk in chunks)
        known = chunks[0].batch.before.after(chunks[0].words[: chunks[0].words_taken]) if chunks else None
        blocks, self._blocks = self._blocks, Counter()
        return Flushed(events, marks, reset, known, blocks)

    def _append(self, batch: Batch, words: Words, events: Events, marks: Marks) -> None:
        if not len(words):
            return
        self._used += len(words)
        self._events += len(events)
        self._marks += len(marks)
        blocks = batch.blocks[: batch.encoded.blocks_in(len(words))] if batch.blocks else ()
        self._blocks.update(block.reading.kind for block in blocks)
        self._chunks.append(_Chunk(batch, words, events, marks, blocks))
