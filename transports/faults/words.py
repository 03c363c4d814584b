"""Faults of the words of a DAVIS346, transfer by transfer; the word layout is drawn in `davis346.words`.

`WordStage` is one active fault. `WordPath` passes the words through the stages, and compares the result with the
original until they agree again.

`Survivors` finds the events and edges that reach an intact receiver. Two decoders read: one the words that the camera
sent, the other those that arrive. An event or edge survives when its own word arrives and gives the same time, place
and polarity. A receiver that misses a wrap therefore has no event of the camera's until the next timestamp reset: all
its times are wrong. An additional byte at the end of a transfer is discarded, as libcaer does.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from firmware_protocol.davis346.decoder import Decoded, Decoder
from firmware_protocol.davis346.settings import PRODUCT_ID, VENDOR_ID
from firmware_protocol.davis346.words import MAX_ADDRESS, Special, Words, is_column
from firmware_protocol.usb.device import Identity, Transfer
from transports.faults.kinds import Fault, Places
from transports.faults.script import Stage
from transports.faults.usb_kinds import (
    MissedWraps,
    OddBytes,
    RepeatedEvents,
    StaleData,
    TimeAhead,
    TimeBack,
    TimeFrozen,
)

__all__ = ["INSERTED", "SentWords", "Survivors", "WordPath", "WordStage", "inserted", "word_stage"]


INSERTED = -1
"""Origin of a word that the camera did not send."""

_WORD = np.dtype("<u2")
_TIMESTAMP, _WRAP, _KIND, _LOW = 0x8000, 0x7000, 0xF000, 0x7FFF
_ROW, _COLUMN_OFF = 0x1000, 0x2000
_STALE_WORDS = 3  # timestamp, row, column
_STALE_ADDRESSES = 260  # inside the array, rotated or not


@dataclass(frozen=True)
class SentWords:
    """Words of one transfer, each with its origin.

    Attributes
    ----------
    words
        (n,) uint16.
    origin
        (n,) index of the word among those that the camera sent; INSERTED: it did not send this word.
    odd
        A byte after the last word, or none.
    """

    words: Words
    origin: npt.NDArray[np.int64]
    odd: bytes = b""

    @classmethod
    def of(cls, data: bytes) -> SentWords:
        """Return the words as the camera sent them."""
        words = np.frombuffer(data, _WORD)
        return cls(words, np.arange(len(words)))

    @property
    def data(self) -> bytes:
        """Bytes on the cable."""
        return self.words.tobytes() + self.odd

    def only(self, good: npt.NDArray[np.bool_]) -> SentWords:
        """Return the words that are `good`, (n,)."""
        return SentWords(self.words[good], self.origin[good], self.odd)


def inserted(sent: SentWords, at: int, words: list[int]) -> SentWords:
    """Return `sent` with `words` inserted before word `at`, of origin INSERTED."""
    new = np.array(words, _WORD)
    places = np.full(len(words), at)
    return SentWords(
        np.insert(sent.words, places, new), np.insert(sent.origin, places, np.full(len(words), INSERTED)), sent.odd
    )


class WordStage(Stage, ABC):
    """One active fault of words."""

    endpoint = 2

    def room(self, max_bytes: int) -> int:
        """Return the number of bytes that the camera may send, so that the changed transfer fits into `max_bytes`."""
        return max_bytes

    @abstractmethod
    def change(self, sent: SentWords) -> SentWords:
        """Return the words that arrive in place of one transfer."""

    def started(self) -> None:
        """Record that the host has started the data endpoint."""
        return

    def finish(self) -> list[int]:
        """Return the words that follow at the end of the fault."""
        return []


class _OddEnds(WordStage):
    def __init__(self, fault: OddBytes, random: np.random.Generator) -> None:
        super().__init__()
        self._where, self._random = Places(fault, random), random
        self._extra = fault.change == "extra"

    def room(self, max_bytes: int) -> int:
        return max_bytes - 2 if self._extra else max_bytes

    def change(self, sent: SentWords) -> SentWords:
        if not len(sent.words) or sent.odd or not self._where.within(1):
            return sent
        self.count(1, 1)
        self.over = self._where.over
        if self._extra:
            return SentWords(sent.words, sent.origin, self._random.bytes(1))
        return SentWords(sent.words[:-1], sent.origin[:-1], sent.words[-1:].tobytes()[:1])


class _Repetition(WordStage):
    def __init__(self, fault: RepeatedEvents, random: np.random.Generator) -> None:
        super().__init__()
        self._where = Places(fault, random)

    def room(self, max_bytes: int) -> int:
        return max_bytes // 4 * 2

    def change(self, sent: SentWords) -> SentWords:
        columns = np.flatnonzero(is_column(sent.words))
        twice = columns[self._where.within(len(columns))]
        self.count(len(twice), len(twice))
        self.over = self._where.over
        words = np.insert(sent.words, twice + 1, sent.words[twice])
        return SentWords(words, np.insert(sent.origin, twice + 1, sent.origin[twice]), sent.odd)


class _MissedWraps(WordStage):
    def __init__(self, fault: MissedWraps, random: np.random.Generator) -> None:
        super().__init__()
        self._where = Places(fault, random)

    def change(self, sent: SentWords) -> SentWords:
        wraps = np.flatnonzero(_is_wrap(sent.words))
        gone = wraps[self._where.within(len(wraps))]
        self.count(len(gone), len(gone))
        self.over = self._where.over
        good = np.ones(len(sent.words), np.bool_)
        good[gone] = False
        return sent.only(good)


class _Ahead(WordStage):
    def __init__(self, fault: TimeAhead) -> None:
        super().__init__()
        self._wraps = fault.wraps

    def room(self, max_bytes: int) -> int:
        return max(0, max_bytes - 2 * self._wraps)

    def change(self, sent: SentWords) -> SentWords:
        timing = np.flatnonzero(sent.words >= _WRAP)  # a wrap anywhere else would also change the current low bits
        if self.over or not len(timing):
            return sent
        self.count(1, self._wraps)
        self.over = True
        return inserted(sent, int(timing[0]), [_WRAP | 1] * self._wraps)


class _Back(WordStage):
    def __init__(self, fault: TimeBack) -> None:
        super().__init__()
        self._by = fault.by_us

    def change(self, sent: SentWords) -> SentWords:
        stamps = sent.words >= _TIMESTAMP
        words = sent.words.copy()
        low = (words[stamps] & _LOW).astype(np.int64)
        words[stamps] = (np.maximum(low - self._by, 0) | _TIMESTAMP).astype(_WORD)
        count = int(np.count_nonzero(stamps))
        self.count(count, count)
        return SentWords(words, sent.origin, sent.odd)


class _Frozen(WordStage):
    def __init__(self) -> None:
        super().__init__()
        self._held: list[int] = []

    def change(self, sent: SentWords) -> SentWords:
        resets = np.flatnonzero(sent.words == int(Special.TIMESTAMP_RESET))
        timing = sent.words >= _WRAP
        if len(resets):
            self._held = []
        wraps = np.flatnonzero(_is_wrap(sent.words))
        self._held += sent.words[wraps[wraps > (resets[-1] if len(resets) else -1)]].tolist()
        count = int(np.count_nonzero(timing))
        self.count(count, count)
        return sent.only(~timing)

    def finish(self) -> list[int]:
        return self._held


class _Stale(WordStage):
    def __init__(self, fault: StaleData, random: np.random.Generator) -> None:
        super().__init__()
        self._events, self._random = fault.events, random
        self._due = False

    def started(self) -> None:
        self._due = True

    def room(self, max_bytes: int) -> int:
        return max(0, max_bytes - 2 * _STALE_WORDS * self._events) if self._due else max_bytes

    def change(self, sent: SentWords) -> SentWords:
        if not self._due or self.over:
            return sent
        self.count(1, _STALE_WORDS * self._events)
        self.over = True
        return inserted(sent, 0, self._words())

    def _words(self) -> list[int]:
        """Return timestamp, row and column of each event, in order of increasing time."""
        times = np.sort(self._random.choice(_LOW, self._events, replace=False) + 1)
        addresses = self._random.integers(0, _STALE_ADDRESSES, (2, self._events))
        triples = np.stack([times | _TIMESTAMP, addresses[0] | _ROW, addresses[1] | _COLUMN_OFF], axis=1)
        words: list[int] = triples.ravel().tolist()
        return words


def word_stage(fault: Fault, random: np.random.Generator) -> WordStage | None:
    """Return the stage of a fault of words; None for a fault that does not change words."""
    match fault:
        case OddBytes():
            return _OddEnds(fault, random)
        case RepeatedEvents():
            return _Repetition(fault, random)
        case MissedWraps():
            return _MissedWraps(fault, random)
        case TimeAhead():
            return _Ahead(fault)
        case TimeBack():
            return _Back(fault)
        case TimeFrozen():
            return _Frozen()
        case StaleData():
            return _Stale(fault, random)
    return None


def _is_wrap(words: Words) -> npt.NDArray[np.bool_]:
    wraps: npt.NDArray[np.bool_] = words & _KIND == _WRAP
    return wraps


_ANY_SIZE = (MAX_ADDRESS + 1, MAX_ADDRESS + 1)  # faults change no address

_MARKS = [
    int(code)
    for code in (
        Special.INPUT_FALLING, Special.INPUT_RISING, Special.INPUT_PULSE, Special.GENERATOR_FALLING,
        Special.GENERATOR_RISING,
    )
]  # fmt: skip

Mask = npt.NDArray[np.bool_]


class Survivors:
    """Comparison of the words sent with the words that arrive, from its creation on."""

    def __init__(self) -> None:
        # Earlier words are the same for both, so both may begin at time zero and row zero.
        self._sent, self._arrived = Decoder(_ANY_SIZE), Decoder(_ANY_SIZE)

    @property
    def agree(self) -> bool:
        """True when a receiver is in step again: the same time and the same row."""
        states = [(decoder.time_us, decoder.row) for decoder in (self._sent, self._arrived)]
        return states[0] == states[1]

    def of(self, transfer: Transfer, arriving: SentWords) -> Transfer:
        """Return `transfer` with the arriving data, and with the events and edges that survive."""
        original = SentWords.of(transfer.data)
        sent, arrived = self._sent.feed(transfer.data), self._arrived.feed(arriving.words.tobytes())
        events = _same(_columns(original, sent), _columns(arriving, arrived), len(original.words))
        edges = _same(_marks(original, sent), _marks(arriving, arrived), len(original.words))
        return replace(
            transfer,
            data=arriving.data,
            events=transfer.events[events[is_column(original.words)]],
            edges=transfer.edges[edges[_is_mark(original.words)]],
        )


def _columns(sent: SentWords, decoded: Decoded) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.void]]:
    """Return the origin of each event word, and the events."""
    return sent.origin[is_column(sent.words)], decoded.events


def _marks(sent: SentWords, decoded: Decoded) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.void]]:
    """Return the origin of each edge's word, and their times and codes."""
    marks = decoded.specials[_is_mark(decoded.specials["code"])]
    return sent.origin[_is_mark(sent.words)], marks[["t", "code"]]


def _same(
    sent: tuple[npt.NDArray[np.int64], npt.NDArray[np.void]],
    arrived: tuple[npt.NDArray[np.int64], npt.NDArray[np.void]],
    words: int,
) -> Mask:
    """Return for each word sent if it arrives with the same meaning, (words,)."""
    (at, meant), (origin, told) = sent, arrived
    index = np.full(words, -1)
    index[at] = np.arange(len(at))
    known = origin >= 0
    origin, told = origin[known], told[known]
    good = np.zeros(words, np.bool_)
    good[origin[told == meant[index[origin]]]] = True
    return good


def _is_mark(words: Words) -> Mask:
    return np.isin(words, _MARKS)


class WordPath:
    """Path of the words of one camera through the faults.

    Attributes
    ----------
    front
        Words that are inserted before the next transfer.
    """

    def __init__(self, camera: Identity) -> None:
        self._has_words = (camera.vendor_id, camera.product_id) == (VENDOR_ID, PRODUCT_ID)
        self._survivors: Survivors | None = None
        self._epoch_us = self._next_front = 0
        self.front: list[int] = []

    def needed(self, stages: Sequence[WordStage]) -> bool:
        """Return True if transfers have to take this path."""
        return self._has_words and bool(stages or self.front or self._survivors)

    def room(self, stages: Sequence[WordStage], max_bytes: int) -> int:
        """Return the number of bytes that the camera may send, so that the arriving transfer fits into `max_bytes`."""
        self._next_front = min(len(self.front), max_bytes // 4)  # half of a transfer at most
        max_bytes -= 2 * self._next_front
        for stage in reversed(stages):
            max_bytes = stage.room(max_bytes)
        return max_bytes

    def changed(self, transfer: Transfer, stages: Sequence[WordStage]) -> Transfer:
        """Return the transfer that arrives, with the events and edges that survive."""
        sent = SentWords.of(transfer.data)
        for stage in stages:
            sent = stage.change(sent)
        sent, self.front = inserted(sent, 0, self.front[: self._next_front]), self.front[self._next_front :]
        if self._survivors is None or transfer.epoch_us != self._epoch_us:
            # After a clock reset, a receiver without earlier data begins a new stream.
            self._survivors, self._epoch_us = Survivors(), transfer.epoch_us
        arrived = self._survivors.of(transfer, sent)
        if not stages and not self.front and self._survivors.agree:
            self._survivors = None
        return arrived
