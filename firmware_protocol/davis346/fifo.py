"""The camera's FIFO: words that wait for the host, with the events that they will complete.

Its size is stated in bytes of words. When it is full, the newest events are dropped, always whole ones, so that what
was taken in is a valid stream. The last 64 words are kept for wraps: through 2 s of a stalled host they still go in one
by one, as neuromorphic_drivers needs them. One word beyond the size is kept for a timestamp reset: it always gets in.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from firmware_protocol.davis346.words import Encoded, Special, Words, WordState, is_column
from firmware_protocol.event_copies import join_events
from firmware_protocol.events import Events

__all__ = ["Batch", "Fifo", "Flushed", "Taken"]

_MIN_BYTES = 1024
_WRAP_RESERVE_WORDS = 64


@dataclass(frozen=True)
class Batch:
    """Words that go into the FIFO, the events they complete, and what a reader knows before them.

    `epoch_us` is the stream time at which device time is zero for these words.
    """

    encoded: Encoded
    events: Events
    before: WordState
    epoch_us: int

    @property
    def is_reset(self) -> bool:
        """True for a timestamp reset, which stands alone."""
        words = self.encoded.words
        return len(words) == 1 and int(words[0]) == Special.TIMESTAMP_RESET


@dataclass
class _Chunk:
    """A batch in the queue, `words_taken` and `events_taken` of which have left."""

    batch: Batch
    words: Words
    events: Events
    words_taken: int = 0
    events_taken: int = 0

    def take(self, max_words: int) -> tuple[Words, Events]:
        """Remove up to `max_words` words; return them and the events they complete."""
        words = self.words[self.words_taken : self.words_taken + max_words]
        self.words_taken += len(words)
        left = self.events[self.events_taken :]
        done = len(left) if self.words_taken == len(self.words) else int(np.count_nonzero(is_column(words)))
        self.events_taken += done
        return words, left[:done]


@dataclass(frozen=True)
class Taken:
    """What left the FIFO: bytes, the events they complete, and the epoch of all of them."""

    data: bytes
    events: Events
    epoch_us: int


@dataclass(frozen=True)
class Flushed:
    """What a flush dropped: events, whether a reset was among the words, and what the reader knows without them.

    `known` is None when nothing was queued.
    """

    events: int
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
        self._events = 0
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

    def put(self, batch: Batch) -> int:
        """Take in as many whole events from the front of `batch` as fit; return their words' number."""
        words, events = batch.encoded.words, batch.events
        if len(words) > self.free_words:
            ends = batch.encoded.ends
            fitting = int(np.searchsorted(ends, self.free_words, side="right"))
            words = words[: ends[fitting - 1]] if fitting else words[:0]
            events = events[:fitting]
        self._append(batch, words, events)
        return len(words)

    def put_wraps(self, batch: Batch) -> None:
        """Take in wraps, which the caller has made to fit into `free_wrap_words`."""
        self._append(batch, batch.encoded.words, batch.events)

    def put_reset(self, batch: Batch) -> None:
        """Take in a timestamp reset word, also when full; one directly after another adds nothing."""
        if self._chunks and self._chunks[-1].batch.is_reset:
            self._chunks[-1].batch = batch
            return
        self._append(batch, batch.encoded.words, batch.events)

    def take(self, max_bytes: int) -> Taken | None:
        """Remove up to `max_bytes` bytes of whole words, all of one epoch; None when there are none."""
        room = max_bytes // 2
        if not self._chunks or room < 1:
            return None
        epoch_us = self._chunks[0].batch.epoch_us
        words: list[Words] = []
        events: list[Events] = []
        while room and self._chunks and self._chunks[0].batch.epoch_us == epoch_us:
            chunk = self._chunks[0]
            taken, completed = chunk.take(room)
            words.append(taken)
            events.append(completed)
            room -= len(taken)
            if chunk.words_taken == len(chunk.words):
                self._chunks.popleft()
        return self._leave(words, events, epoch_us)

    def flush(self) -> Flushed:
        """Drop everything."""
        dropped, self._events, self._used = self._events, 0, 0
        chunks, self._chunks = self._chunks, deque()
        reset = any(chunk.batch.is_reset for chunk in chunks)
        known = chunks[0].batch.before.after(chunks[0].words[: chunks[0].words_taken]) if chunks else None
        return Flushed(dropped, reset, known)

    def _append(self, batch: Batch, words: Words, events: Events) -> None:
        if not len(words):
            return
        self._used += len(words)
        self._events += len(events)
        self._chunks.append(_Chunk(batch, words, events))

    def _leave(self, words: list[Words], events: list[Events], epoch_us: int) -> Taken:
        data = b"".join(part.data for part in words)
        completed = join_events(events)
        self._used -= len(data) // 2
        self._events -= len(completed)
        return Taken(data, completed, epoch_us)
