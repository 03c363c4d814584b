"""The 16-bit words of an FX3 camera's data stream: times and wraps, specials, misc data, and the state of a reader.

    bits 15..12  meaning                                    bits 11..0
    1xxx         timestamp                                  low 15 bits: microseconds since the last wrap
    0000         special                                    code, see Special
    0001 - 0100  events and samples of the model            see `davis346.words`, `dvxplorer.words`
    0101         misc, 8 bits of data                       code 11..8, data 7..0
    0110         misc, 10 bits of data                      code 11..10, data 9..0
    0111         timestamp wrap                             number of steps of 32768 us

Little-endian; the unit is the word, not the USB packet. Source: the parsers of libcaer 3.3.15 (davis.c) and
neuromorphic-drivers 0.16.1, and runs against both and dv-processing 2.0.4.

Rules that the encoder follows because drivers depend on them:

- A timestamp word comes before the words of its time, only if the time has changed, and times strictly increase:
  dv-processing 2.0.4 stops reading for good at a repeated one. A wrap sets the time to its own multiple of 32768 us, so
  an event at exactly that time needs no timestamp word.
- A mark (an edge of the external input, a pulse of the generator) is a special word with a time, like an event. In the
  same microsecond it comes before the events, as in the multiplexer of the published logic, which reads that input
  first.
- A block (part of a frame, an inertial sample) has one time, like a mark, and no other word comes between its words.
- There is one wrap word of one step for each 32.768 ms, because neuromorphic_drivers ignores the number of steps (see
  `settings`). Words of many steps are used if more than SINGLE_WRAPS wraps are due.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import numpy.typing as npt

Words = npt.NDArray[np.uint16]
"""Words in stream order, shape (n,), little-endian uint16."""

WORD = np.dtype("<u2")
# Plain ints, not an IntEnum: numpy reads an enum's member as an int64 and would widen every array it meets.
ROW = 0x1000
COLUMN_OFF = 0x2000
COLUMN_ON = 0x3000
APS_SAMPLE = 0x4000
MISC8 = 0x5000
MISC10 = 0x6000
WRAP = 0x7000
TIMESTAMP = 0x8000
KIND = 0xF000
LOW_BITS = 0x7FFF
WRAP_BITS = 15
MAX_STEPS = 0xFFF
MAX_ADDRESS = 0xFFF

SINGLE_WRAPS = 4096
"""Wraps sent one by one at most: 134 s of silence. A longer gap uses words of many steps."""


class Special(IntEnum):
    """Codes of a special word."""

    TIMESTAMP_RESET = 1
    INPUT_FALLING = 2
    INPUT_RISING = 3
    INPUT_PULSE = 4
    IMU_START = 5
    IMU_END = 7
    FRAME_START_GLOBAL = 8
    FRAME_START_ROLLING = 9
    FRAME_END = 10
    RESET_COLUMN = 11
    SIGNAL_COLUMN = 12
    COLUMN_END = 13
    EXPOSURE_START = 14
    EXPOSURE_END = 15
    GENERATOR_FALLING = 16
    GENERATOR_RISING = 17


def is_column(words: Words) -> npt.NDArray[np.bool_]:
    """Return a mask of the words that are columns, that is, complete an event."""
    columns: npt.NDArray[np.bool_] = (words & 0xE000) == COLUMN_OFF
    return columns


def is_mark(words: Words) -> npt.NDArray[np.bool_]:
    """Return a mask of the words that are marks: specials of the external input and of the generator."""
    marks: npt.NDArray[np.bool_] = (words - 2 <= 2) | (words - 16 <= 1)  # words are unsigned: 0 - 2 is large
    return marks


def is_row(words: Words) -> npt.NDArray[np.bool_]:
    """Return a mask of the words that are rows."""
    rows: npt.NDArray[np.bool_] = (words & KIND) == ROW
    return rows


@dataclass(frozen=True)
class WordState:
    """State of a reader of the stream: device time of the last timestamp or wrap, and the row (-1: none yet)."""

    time_us: int = 0
    row: int = -1

    def after(self, words: Words) -> WordState:
        """Return the state of a reader that has also read `words` (of a stream without resets)."""
        steps = int((words[words & KIND == WRAP] & MAX_STEPS).sum(dtype=np.int64))
        time_us = ((self.time_us >> WRAP_BITS) + steps) << WRAP_BITS if steps else self.time_us
        timing = words[words >= WRAP]
        if len(timing) and timing[-1] & TIMESTAMP:
            time_us = (time_us >> WRAP_BITS << WRAP_BITS) + int(timing[-1] & LOW_BITS)
        rows = words[is_row(words)]
        return WordState(time_us, int(rows[-1] & MAX_ADDRESS) if len(rows) else self.row)


@dataclass(frozen=True)
class Encoded:
    """Words of a run of events, marks and blocks, shape (n_words,); `block_ends`: one past each block's last word."""

    words: Words
    block_ends: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))

    @property
    def ends(self) -> npt.NDArray[np.int64]:
        """(n_events + n_marks + n_blocks,): index one past the last word of each event, mark or block."""
        ends: npt.NDArray[np.int64] = np.flatnonzero(is_column(self.words) | is_mark(self.words)) + 1
        return np.sort(np.concatenate([ends, self.block_ends])) if len(self.block_ends) else ends

    def events_in(self, words: Words) -> int:
        """Return the number of events that a part of the words completes."""
        return int(np.count_nonzero(is_column(words)))

    def blocks_in(self, count: int) -> int:
        """Return the number of blocks that the first `count` words complete."""
        return int(np.searchsorted(self.block_ends, count, side="right"))


def wrap_words(steps: int, room: int = SINGLE_WRAPS) -> Words | None:
    """Return words that add `steps` wraps: single ones if at most `room` words are enough, else as few as possible.

    None if even these do not fit.
    """
    if steps <= min(room, SINGLE_WRAPS):
        return np.full(steps, WRAP | 1, WORD)
    full, remaining = divmod(steps, MAX_STEPS)
    if full + bool(remaining) > room:
        return None
    words = np.full(full + bool(remaining), WRAP | MAX_STEPS, WORD)
    if remaining:
        words[-1] = WRAP | remaining
    return words
