"""The camera's data path after the gate: encoder, FIFO and device time.

The FIFO holds words that wait for the host, with the events that they will complete. Its size is given in bytes of
words. When it is full, the newest events, marks and blocks are dropped, always complete ones, so that its content is a
valid stream. The last 64 words are reserved for wraps: if the host stalls for up to 2 s, wraps still enter one by one,
as neuromorphic_drivers needs them. One more word beyond the size is reserved for a timestamp reset, which always
enters.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import numpy as np

from firmware_protocol.device.items import Numbers, Reading, count_kinds
from firmware_protocol.events import Events, empty_edges, empty_events, join_events
from firmware_protocol.fx3.words import (
    SINGLE_WRAPS,
    WORD,
    WRAP_BITS,
    Block,
    Encoded,
    Marks,
    Special,
    Words,
    WordState,
    edges_of,
    is_mark,
    is_row,
    no_marks,
    wrap_words,
)
from firmware_protocol.usb.device import Transfer

_MIN_BYTES = 1024
_WRAP_RESERVE_WORDS = 64


class TimedEncoder(ABC):
    """Encoder of items into words with the times of an FX3 camera; it holds the state of the stream's reader.

    `rows`: number of row words of the last call of `encode`; `words_per_event`: most words of an event, without wraps.
    """

    words_per_event: ClassVar[int] = 3

    def __init__(self) -> None:
        self.state = WordState()
        self.rows = 0

    def reset(self) -> Words:
        """Restart time with a timestamp reset word; after it device time is zero and no row is in force."""
        self.state = WordState()
        return np.full(1, Special.TIMESTAMP_RESET, WORD)

    def advance(self, now_us: int, room: int = SINGLE_WRAPS) -> Words:
        """Return the wraps due up to `now_us`, in at most `room` words; none if they do not fit, for a later call."""
        steps = (now_us >> WRAP_BITS) - (self.state.time_us >> WRAP_BITS)
        if steps <= 0:
            return np.empty(0, WORD)
        words = wrap_words(steps, room)
        if words is None:
            return np.empty(0, WORD)
        self.state = WordState(now_us >> WRAP_BITS << WRAP_BITS, self.state.row)
        return words

    def count(self, queued: Words, dropped: Words) -> None:  # noqa: B027  # not every model counts more than rows
        """Count words of a call of `encode` that were queued, and those that found no room, for statistics."""

    @abstractmethod
    def encode(
        self, events: Events, epoch_us: int = 0, marks: Marks | None = None, blocks: Sequence[Block] = ()
    ) -> Encoded:
        """Return the words of `events`, (n,) EVENT, `marks`, (m,) MARK, and `blocks`, each in time order.

        Raises ValueError where they go back in time, lie before the epoch or outside the array, or leave a gap of days.

        Parameters
        ----------
        events : Events in stream time.
        epoch_us : Stream time at which device time is zero.
        marks : Marks in stream time, placed between the events by their time.
        blocks : Runs of words in stream time, placed likewise; at one time after marks and before events.
        """


@dataclass
class Batch:
    """Words in the FIFO, and the events, marks and blocks that they complete and that have not left.

    Attributes
    ----------
    before : state of a reader before the first word.
    epoch_us : stream time at which device time is zero for these words.
    words_taken : number of words that have left.
    """

    encoded: Encoded
    before: WordState
    epoch_us: int
    events: Events = field(default_factory=empty_events)
    marks: Marks = field(default_factory=no_marks)
    blocks: Sequence[Block] = ()
    words_taken: int = 0

    @property
    def numbers(self) -> Numbers:
        """Numbers of its items that have not left."""
        return Numbers(len(self.events), len(self.marks), count_kinds([block.reading for block in self.blocks]))

    @property
    def is_reset(self) -> bool:
        """True for a timestamp reset, which stands alone."""
        words = self.encoded.words
        return len(words) == 1 and int(words[0]) == Special.TIMESTAMP_RESET

    @property
    def reader_state(self) -> WordState:
        """State of a reader of the words that have left."""
        return self.before.after(self.encoded.words[: self.words_taken])

    @property
    def is_empty(self) -> bool:
        """True if all words have left."""
        return self.words_taken == len(self.encoded.words)

    def fitting(self, room: int) -> Batch:
        """Return as many complete items from the front as fit `room` words."""
        if len(self.encoded.words) <= room:
            return self
        ends = self.encoded.ends
        count = int(np.searchsorted(ends, room, side="right"))
        words = self.encoded.words[: ends[count - 1] if count else 0]
        return replace(
            self,
            encoded=replace(self.encoded, words=words),
            events=self.events[: self.encoded.events_in(words)],
            marks=self.marks[: np.count_nonzero(is_mark(words))],
            blocks=self.blocks[: self.encoded.blocks_in(len(words))],
        )

    def take(self, max_words: int) -> tuple[Words, Events, Marks, Sequence[Block]]:
        """Remove up to `max_words` words; return them and the events, marks and blocks they complete."""
        words = self.encoded.words[self.words_taken : self.words_taken + max_words]
        blocks_before = self.encoded.blocks_in(self.words_taken) if self.blocks else 0
        self.words_taken += len(words)
        events = self.events
        marks = self.marks
        blocks = self.blocks
        if not self.is_empty:
            events = events[: self.encoded.events_in(words)]
            marks = marks[: np.count_nonzero(is_mark(words))] if len(marks) else marks
            blocks = blocks[: self.encoded.blocks_in(self.words_taken) - blocks_before] if blocks else ()
        self.events, self.marks = self.events[len(events) :], self.marks[len(marks) :]
        self.blocks = self.blocks[len(blocks) :]
        return words, events, marks, blocks


class Flushed(NamedTuple):
    """Content that a flush dropped: a reset if there was one, and the reader's state; None if nothing was queued."""

    reset: bool
    reader_state: WordState | None


class Fifo:
    """A bounded queue of words.

    Parameters
    ----------
    capacity_bytes : size; at least 1024.

    Attributes
    ----------
    waiting : numbers of events, marks and blocks whose last word has not left.
    """

    def __init__(self, capacity_bytes: int) -> None:
        if capacity_bytes < _MIN_BYTES:
            raise ValueError(f"a FIFO of {capacity_bytes} bytes is too small; give it at least {_MIN_BYTES}")
        self._capacity = capacity_bytes // 2
        self._used = 0
        self.waiting = Numbers()
        self._batches: deque[Batch] = deque()

    @property
    def free_words(self) -> int:
        """Free room for words of events."""
        return max(0, self.free_wrap_words - _WRAP_RESERVE_WORDS)

    @property
    def free_wrap_words(self) -> int:
        """Free room for wrap words."""
        return max(0, self._capacity - self._used)

    def put(self, batch: Batch) -> Batch:
        """Append as many complete items from the front of `batch` as fit; return them."""
        return self._append(batch.fitting(self.free_words))

    def put_wraps(self, batch: Batch) -> None:
        """Append wraps, which the caller has limited to `free_wrap_words`."""
        self._append(batch)

    def put_reset(self, batch: Batch) -> None:
        """Append a timestamp reset word, even if the FIFO is full; one directly after another adds nothing."""
        if self._batches and self._batches[-1].is_reset:
            self._batches[-1] = batch
            return
        self._append(batch)

    def take(self, max_bytes: int) -> Transfer | None:
        """Remove up to `max_bytes` bytes of whole words, all of one epoch; None if there are none."""
        room = max_bytes // 2
        if not self._batches or room < 1:
            return None
        epoch_us = self._batches[0].epoch_us
        words: list[Words] = []
        events: list[Events] = []
        marks: list[Marks] = []
        readings: list[Reading] = []
        while room and self._batches and self._batches[0].epoch_us == epoch_us:
            batch = self._batches[0]
            taken, completed, completed_marks, blocks = batch.take(room)
            words.append(taken)
            events.append(completed)
            if len(completed_marks):
                marks.append(completed_marks)
            readings += [block.reading for block in blocks]
            room -= len(taken)
            if batch.is_empty:
                self._batches.popleft()
        data = b"".join([part.data for part in words])
        edges = empty_edges()
        if marks:
            joined = np.concatenate(marks)
            edges = edges_of(joined["t"], joined["code"])
        transfer = Transfer(join_events(events), edges, epoch_us, tuple(readings), data)
        self._used -= len(data) // 2
        self.waiting = self.waiting.less(transfer.numbers)
        return transfer

    def flush(self) -> Flushed:
        """Drop the whole content."""
        batches, self._batches = self._batches, deque()
        self._used, self.waiting = 0, Numbers()
        return Flushed(any(batch.is_reset for batch in batches), batches[0].reader_state if batches else None)

    def _append(self, batch: Batch) -> Batch:
        if len(batch.encoded.words):
            self._used += len(batch.encoded.words)
            self.waiting = self.waiting.plus(batch.numbers)
            self._batches.append(batch)
        return batch


_WRAP_SHARE = 8
"""One in eight of the free words is reserved for wraps in the computed room for events: they may be far apart."""


class Late(NamedTuple):
    """Items that found no room: a number of events, which are dropped, and the marks and blocks, which may wait."""

    events: int
    marks: Marks
    blocks: Sequence[Block]


class EventStream:
    """Stream of the camera, an `ItemEncoder`: it encodes items into the FIFO, and makes transfers of its content.

    `rows`: number of row words queued so far; `epoch_us`: stream time at which device time is zero.
    """

    def __init__(self, encoder: TimedEncoder, fifo: Fifo) -> None:
        self._encoder = encoder
        self._fifo = fifo
        self.epoch_us = 0
        self.rows = 0

    @property
    def waiting(self) -> Numbers:
        """Numbers of items in the FIFO."""
        return self._fifo.waiting

    @property
    def free_words(self) -> int:
        """Free room for words of events."""
        return self._fifo.free_words

    def room_beside(self, reserved_words: int) -> int:
        """Return the number of events that certainly fit beside these words, if none is later than `room_until_us`."""
        free = self._fifo.free_words - self._wraps_that_fit - reserved_words
        return max(0, free // self._encoder.words_per_event)

    @property
    def room_until_us(self) -> int:
        """Stream time up to which single wraps fit now beside the events of `room_beside`."""
        return self.epoch_us + ((self._encoder.state.time_us >> WRAP_BITS) + self._wraps_that_fit << WRAP_BITS)

    @property
    def _wraps_that_fit(self) -> int:
        return min(SINGLE_WRAPS, self._fifo.free_words // _WRAP_SHARE)

    def start_time(self, now_us: int) -> None:
        """Begin device time at zero for a reader in its initial state; drop the queue."""
        self._fifo.flush()
        self.epoch_us = now_us
        self._encoder.reset()

    def reset_time(self, now_us: int) -> None:
        """Begin device time at zero, with a reset word in the stream."""
        before = self._encoder.state
        words = self._encoder.reset()
        self.epoch_us = now_us
        self._fifo.put_reset(self._batch(words, before))

    def put(self, events: Events, marks: Marks | None = None, blocks: Sequence[Block] = ()) -> Late:
        """Queue `events`, (n,) EVENT, `marks`, (m,) MARK, and `blocks`, in stream time and at least one in all."""
        marks = no_marks() if marks is None else marks
        at_start = self._encoder.state
        begins_us = [int(records["t"][0]) for records in (events, marks) if len(records)]
        first_us = min(begins_us + [block.t_us for block in blocks[:1]])
        wraps = self._encoder.advance(first_us - self.epoch_us, self._fifo.free_wrap_words)
        before = self._encoder.state
        try:
            encoded = self._encoder.encode(events, self.epoch_us, marks, blocks)
        except ValueError:
            self._encoder.state = at_start
            raise
        if len(wraps):
            self._fifo.put_wraps(self._batch(wraps, at_start))
        queued = self._fifo.put(Batch(encoded, before, self.epoch_us, events, marks, blocks))
        words = queued.encoded.words
        self._encoder.count(words, encoded.words[len(words) :])
        if len(words) < len(encoded.words):
            self._encoder.state = before.after(words)
            self.rows += int(np.count_nonzero(is_row(words)))
        else:
            self.rows += self._encoder.rows
        return Late(len(events) - len(queued.events), marks[len(queued.marks) :], blocks[len(queued.blocks) :])

    def advance(self, now_us: int) -> None:
        """Queue the wraps due at stream time `now_us` that fit; a later call makes up for the rest."""
        before = self._encoder.state
        words = self._encoder.advance(now_us - self.epoch_us, self._fifo.free_wrap_words)
        if len(words):
            self._fifo.put_wraps(self._batch(words, before))

    def clear(self) -> None:
        """Drop the queue, except a timestamp reset: without it the host would misread all later times.

        The encoder goes back to what the host has read, so that the stream stays valid.
        """
        flushed = self._fifo.flush()
        if flushed.reset:
            self.reset_time(self.epoch_us)
        elif flushed.reader_state is not None:
            self._encoder.state = flushed.reader_state

    def take(self, now_us: int, room: int) -> Transfer | None:
        """Remove up to `room` octets, whatever the time: words enter the FIFO when they are due."""
        return self._fifo.take(room)

    def _batch(self, words: Words, before: WordState) -> Batch:
        return Batch(Encoded(words), before, self.epoch_us)
