"""The camera's FIFO: words that wait for the host, with the events that they will complete.

Its size is stated in bytes of words. When it is full, the newest events and marks are dropped, always whole ones, so
that what was taken in is a valid stream. The last 64 words are kept for wraps: through 2 s of a stalled host they still
go in one by one, as neuromorphic_drivers needs them. One word beyond the size is kept for a timestamp reset: it always
gets in.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from firmware_protocol.davis346.marks import Marks, no_marks
from firmware_protocol.davis346.words import Encoded, Special, Words, WordState, is_column, is_mark
from firmware_protocol.event_copies import join_events
from firmware_protocol.events import Events

__all__ = ["Batch", "Fifo", "Flushed", "Taken"]

_MIN_BYTES = 1024
_WRAP_RESERVE_WORDS = 64


@dataclass(frozen=True)
class Batch:
    """Words that go into the FIFO, the events and marks they complete, and what a reader knows before them.

    `epoch_us` is the stream time at which device time is zero for these words.
    """

    encoded: Encoded
    events: Events
    before: WordState
    epoch_us: int
    marks: Marks = field(default_factory=no_marks)

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
    words_taken: int = 0
    events_taken: int = 0
    marks_taken: int = 0

    def take(self, max_words: int) -> tuple[Words, Events, Marks]:
        """Remove up to `max_words` words; return them and the events and marks they complete."""
        words = self.words[self.words_taken : self.words_taken + max_words]
        self.words_taken += len(words)
        events, marks = self.events[self.events_taken :], self.marks[self.marks_taken :]
        if self.words_taken < len(self.words):
            events = events[: np.count_nonzero(is_column(words))]
            marks = marks[: np.count_nonzero(is_mark(words))] if len(marks) else marks
        self.events_taken += len(events)
        self.marks_taken += len(marks)
        return words, events, marks


@dataclass(frozen=True)
class Taken:
    """What left the FIFO: bytes, the events and marks they complete, and the epoch of all of them."""

    data: bytes
    events: Events
    marks: Marks
    epoch_us: int


@dataclass(frozen=True)
class Flushed:
    """What a flush dropped: events, marks, whether a reset was among the words, and what the reader knows without them.

    `known` is None when nothing was queued.
    """

    events: int
    marks: int
    reset: bool
    known: WordState | None


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

    def put(self, batch: Batch) -> int:
        """Take in as many whole events and marks from the front of `batch` as fit; return their words' number."""
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
        while room and self._chunks and self._chunks[0].batch.epoch_us == epoch_us:
            chunk = self._chunks[0]
            some, completed, told = chunk.take(room)
            words.append(some)
            events.append(completed)
            marks.append(told)
            room -= len(some)
            if chunk.words_taken == len(chunk.words):
                self._chunks.popleft()
        taken = Taken(b"".join(part.data for part in words), join_events(events), np.concatenate(marks), epoch_us)
        self._used -= len(taken.data) // 2
        self._events -= len(taken.events)
        self._marks -= len(taken.marks)
        return taken

    def flush(self) -> Flushed:
        """Drop everything."""
        events, marks, self._events, self._marks, self._used = self._events, self._marks, 0, 0, 0
        chunks, self._chunks = self._chunks, deque()
        reset = any(chunk.batch.is_reset for chunk in chunks)
        known = chunks[0].batch.before.after(chunks[0].words[: chunks[0].words_taken]) if chunks else None
        return Flushed(events, marks, reset, known)

    def _append(self, batch: Batch, words: Words, events: Events, marks: Marks) -> None:
        if not len(words):
            return
        self._used += len(words)
        self._events += len(events)
        self._marks += len(marks)
        self._chunks.append(_Chunk(batch, words, events, marks))
