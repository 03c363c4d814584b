"""The 16-bit words of an FX3 camera's data stream: times, specials, and blocks of words for frames and IMU samples.

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
  `camera`). Words of many steps are used if more than SINGLE_WRAPS wraps are due.

A block is a run of words that belong to one time and stay together among the events of the stream:

    frame start      special 8 or 9, exposure in three misc10 words, region of interest in eight misc8 words
    line             special 11 (reset) or 12 (signal), samples, special 13
    exposure, end    special 14, 15; special 10
    IMU sample       special 5, scale, counts, special 7: see below
    misc8  0x5000 | code << 8 | data     misc10  0x6000 | code << 10 | data     sample  0x4000 | value

The exposure register's 30 bits are sent as bits 9..0, 19..10, 29..20 (misc10 code 0). The region's four values are sent
as start column, start row, end column, end row, each as a high (misc8 code 1) and a low byte (code 2). Source: libcaer
3.3.15 (davis.c); verified with three drivers.

The encoder treats a block as a mark with the word `PLACE`, and replaces that word with the block's words at the end.

A mark is a special word that reports an edge of the external input or of the generator:

    t       u64   stream time, us
    code    u16   word of the stream: 2 falling edge, 3 rising edge, 4 pulse, 16 and 17 generator falls, rises

The codes are those of the published logic (EventCodes.vhd: EXT_INPUT_FALLING 2, RISING 3, PULSE 4, INPUTGEN_FALLING 16,
INPUTGEN_RISING 17). A host's library numbers them otherwise (libcaer, events/special.h: rising 2, falling 3, pulse 4,
generator rising 12, falling 13); `EDGE` records use those numbers.

IMU samples carry the counts of the converters:

    special 5        start
    misc8, code 3    scale   7 accelerometer, 6 gyroscope, 5 temperature is there
                             3..2 range of the accelerometer, 2 g * 2^n   1..0 of the gyroscope, 250 deg/s * 2^n
    misc8, code 0    upper and lower byte of each count, signed 16 bits: accelerometer x, y, z, temperature,
                     gyroscope x, y, z; absent parts are left out
    special 7        end; its time is that of the sample

    acceleration, g       count * 4 * 2^range / 65536
    rate, deg/s           count * 500 * 2^range / 65536
    temperature, C        count / 340 + 35 (unit 1)    count / 333.87 + 21 (unit 2)

Source: the parsers of libcaer 3.3.15 (davis.c) and neuromorphic-drivers 0.16.1. libcaer drops a sample whose number of
bytes does not agree with its scale; so does this reader, which counts it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from firmware_protocol.device.items import Reading, ReadingKind, Readings
from firmware_protocol.events import EdgeKind, Edges, make_edges
from firmware_protocol.frames import LineKind
from firmware_protocol.imu_samples import IMU_SAMPLE, ImuSamples

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
    return (words - 2 <= 2) | (words - 16 <= 1)  # words are unsigned: 0 - 2 is large


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
    """Return words that add `steps` wraps: single ones if `room` suffices, else the fewest; None if they do not fit."""
    if steps <= min(room, SINGLE_WRAPS):
        return np.full(steps, WRAP | 1, WORD)
    full, remaining = divmod(steps, MAX_STEPS)
    if full + bool(remaining) > room:
        return None
    words = np.full(full + bool(remaining), WRAP | MAX_STEPS, WORD)
    if remaining:
        words[-1] = WRAP | remaining
    return words


MARK = np.dtype([("t", "<u8"), ("code", "<u2")])

Marks = npt.NDArray[np.void]
"""An array of MARK records, shape (n,), sorted by t."""

GENERATOR_RISING, GENERATOR_FALLING = 12, 13
"""Kinds of EDGE records beyond EdgeKind that only a DAVIS346's generator makes."""


_KIND_OF_CODE = np.zeros(18, np.uint8)
_KIND_OF_CODE[Special.INPUT_FALLING] = EdgeKind.FALLING
_KIND_OF_CODE[Special.INPUT_RISING] = EdgeKind.RISING
_KIND_OF_CODE[Special.INPUT_PULSE] = EdgeKind.PULSE
_KIND_OF_CODE[Special.GENERATOR_FALLING] = GENERATOR_FALLING
_KIND_OF_CODE[Special.GENERATOR_RISING] = GENERATOR_RISING


def no_marks(n: int = 0) -> Marks:
    """Return an array of `n` zeroed marks."""
    return np.zeros(n, MARK)


def join_marks(parts: list[Marks]) -> Marks:
    """Return the (n,) MARK arrays of `parts` in one, in time order; marks of one time stay in the order given."""
    marks = np.concatenate([no_marks(), *parts])
    return marks[np.argsort(marks["t"], kind="stable")]


def edges_of(times_us: npt.NDArray[np.uint64], codes: Words) -> Edges:
    """Return the (n,) EDGE records that a reader makes of marks at `times_us` (n,) with stream codes `codes` (n,)."""
    return make_edges(times_us, _KIND_OF_CODE[codes])


IMU_READ = np.dtype([("sample", IMU_SAMPLE), ("resets", "<u4")])
"""A sample in device time, and how many timestamp resets came before it."""


_RESET = int(Special.TIMESTAMP_RESET)  # plain numbers, which numpy compares without widening
_START = int(Special.IMU_START)
_END = int(Special.IMU_END)
_SCALE, _DATA = 0x5300, 0x5000
_HIGH_BYTE = 0xFF00
_GROUPS = ((7, slice(0, 3)), (5, slice(3, 4)), (6, slice(4, 7)))


def imu_words(sample: ImuSamples) -> Words:
    """Return the words of one sample, (1,) IMU_SAMPLE, without its time."""
    scale, counts = int(sample["scale"][0]), sample["counts"][0]
    present = np.concatenate([counts[group] for _, group in _present(scale)] or [np.empty(0, np.int16)])
    data = present.astype(">i2").view(np.uint8)
    return np.concatenate(
        [[np.uint16(_START), np.uint16(_SCALE | scale)], data.astype(WORD) | WORD.type(_DATA), [np.uint16(_END)]]
    ).astype(WORD)


def _present(scale: int) -> list[tuple[int, slice]]:
    return [(bit, group) for bit, group in _GROUPS if scale >> bit & 1]


def is_imu(words: Words) -> npt.NDArray[np.bool_]:
    """Return a mask of the words that belong to IMU samples."""
    kind = words & _HIGH_BYTE
    mask: npt.NDArray[np.bool_] = (words == _START) | (words == _END) | (kind == _SCALE) | (kind == _DATA)
    return mask


class ImuReader:
    """Reader of the words of IMU samples; it keeps incomplete samples between pieces.

    Attributes
    ----------
    resets : timestamp resets seen so far.
    broken : samples that were too short or too long, or were interrupted by the start of another.
    """

    def __init__(self) -> None:
        self._scale: int | None = None
        self._data = bytearray()
        self._open = False
        self.broken = self.resets = 0

    def feed(self, words: Words, times_us: npt.NDArray[np.int64]) -> npt.NDArray[np.void]:
        """Return the samples that end in `words` (n,), at device times (n,); (m,) IMU_READ. Other words are skipped.

        A timestamp reset ends a sample, as in libcaer.
        """
        complete: list[tuple[tuple[int, int, list[int]], int]] = []
        relevant = is_imu(words) | (words == _RESET)
        for word, time_us in zip(words[relevant].tolist(), times_us[relevant].tolist(), strict=True):
            if word in (_START, _RESET):
                self.broken += self._open
                self._begin(word == _START)
                self.resets += word == _RESET
            elif word == _END:
                complete.extend((sample, self.resets) for sample in self._ended(time_us))
            elif word & _HIGH_BYTE == _SCALE:
                self._scale = word & 0xFF
            else:
                self._data.append(word & 0xFF)
        return np.array(complete, IMU_READ)

    def _begin(self, is_open: bool) -> None:
        self._open, self._scale = is_open, None
        self._data.clear()

    def _ended(self, time_us: int) -> list[tuple[int, int, list[int]]]:
        """Return the sample that ends now, if it is complete."""
        scale, was_open = self._scale, self._open
        data = bytes(self._data)
        self._begin(False)
        if was_open and scale is not None:
            groups = [group for _, group in _present(scale)]
            if len(data) == 2 * sum(group.stop - group.start for group in groups):
                return [(time_us, scale, _counts(data, groups))]
        self.broken += 1
        return []


def _counts(data: bytes, groups: list[slice]) -> list[int]:
    counts, numbers = [0] * 7, iter(np.frombuffer(data, ">i2").tolist())
    for group in groups:
        for k in range(group.start, group.stop):
            counts[k] = next(numbers)
    return counts


PLACE = 0x0FFF
"""A special code that no stream uses."""

_ROI_HIGH, _ROI_LOW = 1, 2
_LINES = (LineKind.RESET, LineKind.SIGNAL)
_LINE_START = np.zeros(len(LineKind), WORD)
_LINE_START[list(_LINES)] = Special.RESET_COLUMN, Special.SIGNAL_COLUMN
_CODE = {
    LineKind.EXPOSURE_START: Special.EXPOSURE_START,
    LineKind.EXPOSURE_END: Special.EXPOSURE_END,
    LineKind.END: Special.FRAME_END,
}


@dataclass(frozen=True)
class Block:
    """Words of one time, us of stream time, and the reading that they carry."""

    t_us: int
    words: Words
    reading: Reading


def frame_words(lines: Readings) -> list[Words]:
    """Return the words of frame lines and frame boundaries, (n,) of `line_record`, one array for each."""
    of_kind = lines["kind"].tolist()
    table = np.empty((len(lines), lines["samples"].shape[1] + 2), WORD)
    table[:, 0] = _LINE_START[lines["kind"]]
    np.bitwise_or(lines["samples"], APS_SAMPLE, out=table[:, 1:-1])
    ends = lines["length"].astype(np.intp) + 1
    table[np.arange(len(lines)), ends] = Special.COLUMN_END
    stops = (ends + 1).tolist()
    return [
        table[k, : stops[k]] if kind in _LINES else _moment_words(LineKind(kind), lines[k])
        for k, kind in enumerate(of_kind)
    ]


def _moment_words(kind: LineKind, line: np.void) -> Words:
    """Return the words of a moment of a frame; its start carries exposure and region of interest."""
    if kind is not LineKind.START:
        return np.array([_CODE[kind]], WORD)
    exposure = int(line["exposure"])
    start = Special.FRAME_START_GLOBAL if line["global_shutter"] else Special.FRAME_START_ROLLING
    parts = [MISC10 | exposure >> shift & 0x3FF for shift in (0, 10, 20)]
    region = [
        MISC8 | code << 8 | byte
        for place in line["roi"].tolist()
        for code, byte in ((_ROI_HIGH, place >> 8), (_ROI_LOW, place & 0xFF))
    ]
    return np.array([start, *parts, *region], WORD)


def blocks_of(kind: ReadingKind, readings: Readings) -> list[Block]:
    """Return readings of a kind, (n,), as blocks; they are copied."""
    copies = readings.copy()
    records = [copies[k : k + 1] for k in range(len(copies))]
    words = frame_words(copies) if kind is ReadingKind.FRAMES else [imu_words(record) for record in records]
    times_us = copies["t"].tolist()
    readings_of = (Reading(kind, record) for record in records)
    return list(map(Block, times_us, words, readings_of))


def with_places(marks: Marks, blocks: Sequence[Block]) -> Marks:
    """Return `marks`, (n,) MARK, with one mark added for each block, in time order; at one time marks come first."""
    if not blocks:
        return marks
    places = no_marks(len(blocks))
    places["t"] = [block.t_us for block in blocks]
    places["code"] = PLACE
    return join_marks([marks, places])


def put_in_place(words: Words, blocks: Sequence[Block]) -> tuple[Words, npt.NDArray[np.int64]]:
    """Return words with each `PLACE` replaced by its block, and (n_blocks,) one past the last word of each block."""
    if not blocks:
        return words, np.empty(0, np.int64)
    pieces = []
    ends = []
    done = 0
    length = 0
    for at, block in zip(np.flatnonzero(words == PLACE).tolist(), blocks, strict=True):
        pieces += [words[done:at], block.words]
        length += at - done + len(block.words)
        ends.append(length)
        done = at + 1
    return np.concatenate([*pieces, words[done:]]), np.array(ends, np.int64)
