"""Items of the word stream beside events: blocks, marks, and the words of frames and IMU samples.

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
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from firmware_protocol.device.items import Reading, ReadingKind, Readings
from firmware_protocol.events import EDGE, EdgeKind, Edges
from firmware_protocol.frames import LineKind
from firmware_protocol.fx3.words import APS_SAMPLE, MISC8, MISC10, WORD, Special, Words
from firmware_protocol.imu_samples import IMU_SAMPLE, ImuSamples

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

Times = npt.NDArray[np.int64]


def no_marks(n: int = 0) -> Marks:
    """Return an array of `n` zeroed marks."""
    return np.zeros(n, MARK)


def join_marks(parts: list[Marks]) -> Marks:
    """Return the (n,) MARK arrays of `parts` in one, in time order; marks of one time stay in the order given."""
    marks = np.concatenate([no_marks(), *parts])
    return marks[np.argsort(marks["t"], kind="stable")]


def edges_of(times_us: npt.NDArray[np.uint64], codes: Words) -> Edges:
    """Return the (n,) EDGE records that a reader makes of marks at `times_us` (n,) with stream codes `codes` (n,)."""
    edges = np.zeros(len(codes), EDGE)
    edges["t"] = times_us
    edges["kind"] = _KIND_OF_CODE[codes]
    return edges


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
        scale, data, was_open = self._scale, bytes(self._data), self._open
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
