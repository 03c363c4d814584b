"""Faults of the words of a DAVIS346: their tables in a rig, and their effects on each transfer. Sans-I/O.

See `kinds` for the attributes that all faults have. The word layout is drawn in `fx3.words` and `davis346.words`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from firmware_protocol.fx3.words import Special, Words, is_column
from transports.faults.kinds import USB_LINK, Fault, HitFault, LastingFault, Stage

INSERTED = -1
"""Origin of a word that the camera did not send."""

_WORD = np.dtype("<u2")
_TIMESTAMP = 0x8000
_WRAP = 0x7000
_KIND = 0xF000
_LOW = 0x7FFF
_ROW = 0x1000
_COLUMN_OFF = 0x2000
_STALE_WORDS = 3  # timestamp, row, column
_STALE_ADDRESSES = 260  # inside the array, rotated or not
_WRAP_US = 32_768


@dataclass(frozen=True)
class SentWords:
    """Words of one transfer, each with its origin.

    Attributes
    ----------
    words : (n,) uint16.
    origin : (n,) index of the word among those that the camera sent; INSERTED: it did not send this word.
    odd : a byte after the last word, or none.
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
    def room(self, max_bytes: int) -> int:
        return max_bytes - 2 if self._fault.change == "extra" else max_bytes

    def change(self, sent: SentWords) -> SentWords:
        if not len(sent.words) or sent.odd or not self.hit_places(1):
            return sent
        if self._fault.change == "extra":
            return SentWords(sent.words, sent.origin, self._random.bytes(1))
        return SentWords(sent.words[:-1], sent.origin[:-1], sent.words[-1:].tobytes()[:1])


@dataclass(frozen=True)
class OddBytes(HitFault, carriers=(USB_LINK,), effect=_OddEnds):
    """Transfers of an odd length, while the camera sends words of two bytes.

    `rate` is the probability of each transfer.

    Attributes
    ----------
    change : "missing": the last byte never arrives, and its word is lost; "extra": a byte that the camera did not send
        follows.
    """

    change: Literal["missing", "extra"] = "missing"


class _Repetition(WordStage):
    def room(self, max_bytes: int) -> int:
        return max_bytes // 4 * 2

    def change(self, sent: SentWords) -> SentWords:
        columns = np.flatnonzero(is_column(sent.words))
        twice = columns[self.hit_places(len(columns))]
        words = np.insert(sent.words, twice + 1, sent.words[twice])
        return SentWords(words, np.insert(sent.origin, twice + 1, sent.origin[twice]), sent.odd)


@dataclass(frozen=True)
class RepeatedEvents(HitFault, carriers=(USB_LINK,), effect=_Repetition):
    """Events that arrive twice, one after the other. `rate` is the probability of each event."""


class _MissedWraps(WordStage):
    def change(self, sent: SentWords) -> SentWords:
        wraps = np.flatnonzero(_is_wrap(sent.words))
        gone = wraps[self.hit_places(len(wraps))]
        good = np.ones(len(sent.words), np.bool_)
        good[gone] = False
        return sent.only(good)


@dataclass(frozen=True)
class MissedWraps(HitFault, carriers=(USB_LINK,), effect=_MissedWraps):
    """Wraps that never arrive: the host's clock is behind from then on, 32.768 ms each, until a timestamp reset.

    `rate` is the probability of each wrap.
    """


def _is_wrap(words: Words) -> npt.NDArray[np.bool_]:
    wraps: npt.NDArray[np.bool_] = words & _KIND == _WRAP
    return wraps


class _Ahead(WordStage):
    def room(self, max_bytes: int) -> int:
        wraps: int = self._fault.wraps
        return max(0, max_bytes - 2 * wraps)

    def change(self, sent: SentWords) -> SentWords:
        timing = np.flatnonzero(sent.words >= _WRAP)  # a wrap anywhere else would also change the current low bits
        if self.over or not len(timing):
            return sent
        self.count(1, self._fault.wraps)
        self.over = True
        return inserted(sent, int(timing[0]), [_WRAP | 1] * self._fault.wraps)


@dataclass(frozen=True)
class TimeAhead(Fault, carriers=(USB_LINK,), effect=_Ahead):
    """Additional wraps: the host's clock is ahead from then on, until a timestamp reset.

    Attributes
    ----------
    wraps : number of wraps, of 32.768 ms each.
    """

    wraps: Annotated[int, Meta(ge=1, le=100)] = 1


class _Back(WordStage):
    def change(self, sent: SentWords) -> SentWords:
        stamps = sent.words >= _TIMESTAMP
        words = sent.words.copy()
        low = (words[stamps] & _LOW).astype(np.int64)
        words[stamps] = (np.maximum(low - self._fault.by_us, 0) | _TIMESTAMP).astype(_WORD)
        count = int(np.count_nonzero(stamps))
        self.count(count, count)
        return SentWords(words, sent.origin, sent.odd)


@dataclass(frozen=True)
class TimeBack(LastingFault, carriers=(USB_LINK,), effect=_Back):
    """Timestamps that are too low for a time, but never below the last wrap.

    Attributes
    ----------
    by_us : error of the timestamps.
    """

    by_us: Annotated[int, Meta(ge=1, le=_WRAP_US - 1)] = 1000


class _Frozen(WordStage):
    def __init__(self, fault: TimeFrozen, random: np.random.Generator, carrier: Any) -> None:
        super().__init__(fault, random, carrier)
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


@dataclass(frozen=True)
class TimeFrozen(LastingFault, carriers=(USB_LINK,), effect=_Frozen):
    """No timestamps and no wraps for a time: all events have the last time; then all wraps arrive at once."""


class _Stale(WordStage):
    def __init__(self, fault: StaleData, random: np.random.Generator, carrier: Any) -> None:
        super().__init__(fault, random, carrier)
        self._due = False

    def started(self) -> None:
        self._due = True

    def room(self, max_bytes: int) -> int:
        return max(0, max_bytes - 2 * _STALE_WORDS * self._fault.events) if self._due else max_bytes

    def change(self, sent: SentWords) -> SentWords:
        if not self._due or self.over:
            return sent
        self.count(1, _STALE_WORDS * self._fault.events)
        self.over = True
        return inserted(sent, 0, self._words())

    def _words(self) -> list[int]:
        """Return timestamp, row and column of each event, in order of increasing time."""
        times = np.sort(self._random.choice(_LOW, self._fault.events, replace=False) + 1)
        addresses = self._random.integers(0, _STALE_ADDRESSES, (2, self._fault.events))
        triples = np.stack([times | _TIMESTAMP, addresses[0] | _ROW, addresses[1] | _COLUMN_OFF], axis=1)
        return triples.ravel().tolist()


@dataclass(frozen=True)
class StaleData(Fault, carriers=(USB_LINK,), effect=_Stale):
    """Words of an earlier session arrive first when the host starts the data endpoint the next time.

    Attributes
    ----------
    events : number of events in them, each with its own time and row.
    """

    events: Annotated[int, Meta(ge=1, le=1000)] = 100
