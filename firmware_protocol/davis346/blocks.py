"""Blocks: runs of words that belong to one time and stay together, among the events of the stream.

    frame start      special 8 or 9, exposure in three misc10 words, region of interest in eight misc8 words
    line             special 11 (reset) or 12 (signal), samples, special 13
    exposure, end    special 14, 15; special 10
    IMU sample       special 5, scale, counts, special 7: see `imu_words`
    misc8  0x5000 | code << 8 | data     misc10  0x6000 | code << 10 | data     sample  0x4000 | value

The exposure register's 30 bits go as bits 9..0, 19..10, 29..20 (misc10 code 0). The region's four values go as start
column, start row, end column, end row, each a high (misc8 code 1) and a low byte (code 2). Source: libcaer 3.3.15
(davis.c); seen read by three drivers.

The encoder treats a block as a mark with the word `PLACE`, and puts the block's words in its place at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from firmware_protocol.davis346.imu_words import imu_words
from firmware_protocol.davis346.marks import Marks, join_marks, no_marks
from firmware_protocol.frame_lines import LineKind
from firmware_protocol.readings import Reading, ReadingKind, Readings

__all__ = ["PLACE", "Block", "blocks_of", "frame_words", "put_in_place", "with_places"]

PLACE = 0x0FFF
"""A special word that no stream holds."""

APS_SAMPLE, MISC8, MISC10 = 0x4000, 0x5000, 0x6000
_ROI_HIGH, _ROI_LOW = 1, 2
_START_GLOBAL, _START_ROLLING, _END, _RESET, _SIGNAL, _COLUMN_END = 8, 9, 10, 11, 12, 13
_LINES = (LineKind.RESET, LineKind.SIGNAL)
_LINE_START = np.zeros(len(LineKind), "<u2")
_LINE_START[list(_LINES)] = _RESET, _SIGNAL
_CODE = {LineKind.EXPOSURE_START: 14, LineKind.EXPOSURE_END: 15, LineKind.END: _END}

Words = npt.NDArray[np.uint16]


@dataclass(frozen=True)
class Block:
    """Words of one time, us of stream time, and the reading that they tell."""

    t_us: int
    words: Words
    reading: Reading


def frame_words(lines: Readings) -> list[Words]:
    """Return the words of lines and moments of frames, (n,) of `line_record`, those of each by themselves."""
    of_kind = lines["kind"].tolist()
    table = np.empty((len(lines), lines["samples"].shape[1] + 2), "<u2")
    table[:, 0] = _LINE_START[lines["kind"]]
    np.bitwise_or(lines["samples"], APS_SAMPLE, out=table[:, 1:-1])
    ends = lines["length"].astype(np.intp) + 1
    table[np.arange(len(lines)), ends] = _COLUMN_END
    stops = (ends + 1).tolist()
    return [
        table[k, : stops[k]] if kind in _LINES else _moment_words(LineKind(kind), lines[k])
        for k, kind in enumerate(of_kind)
    ]


def _moment_words(kind: LineKind, one: np.void) -> Words:
    if kind is LineKind.START:
        return _start_words(bool(one["global_shutter"]), int(one["exposure"]), one["roi"].tolist())
    return np.array([_CODE[kind]], "<u2")


def _start_words(global_shutter: bool, exposure: int, roi: list[int]) -> Words:
    bits = [MISC10 | exposure >> shift & 0x3FF for shift in (0, 10, 20)]
    halves = [MISC8 | code << 8 | byte for at in roi for code, byte in ((_ROI_HIGH, at >> 8), (_ROI_LOW, at & 0xFF))]
    return np.array([_START_GLOBAL if global_shutter else _START_ROLLING, *bits, *halves], "<u2")


def blocks_of(kind: ReadingKind, readings: Readings) -> list[Block]:
    """Return readings of a kind, (n,), as blocks; they are copied."""
    own = readings.copy()
    each = [own[k : k + 1] for k in range(len(own))]
    words = frame_words(own) if kind is ReadingKind.FRAMES else [imu_words(one) for one in each]
    times_us = own["t"].tolist()
    return [Block(t_us, some, Reading(kind, one)) for t_us, some, one in zip(times_us, words, each, strict=True)]


def with_places(marks: Marks, blocks: Sequence[Block]) -> Marks:
    """Return `marks`, (n,) MARK, and one mark for each block, in time order; marks come first at one time."""
    if not blocks:
        return marks
    places = no_marks(len(blocks))
    places["t"] = [block.t_us for block in blocks]
    places["code"] = PLACE
    return join_marks([marks, places])


def put_in_place(words: Words, blocks: Sequence[Block]) -> tuple[Words, npt.NDArray[np.int64]]:
    """Return words with each block in its place, and (n_blocks,) where each ends: one past its last word."""
    if not blocks:
        return words, np.empty(0, np.int64)
    pieces, ends, done, length = [], [], 0, 0
    for at, block in zip(np.flatnonzero(words == PLACE).tolist(), blocks, strict=True):
        pieces += [words[done:at], block.words]
        length += at - done + len(block.words)
        ends.append(length)
        done = at + 1
    return np.concatenate([*pieces, words[done:]]), np.array(ends, np.int64)
