"""All that a DAVIS346 sends, for measurements: events of a saturated read-out, frames, inertial samples, marks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

import numpy as np

from emulator.bench.streams import saturated_stream
from firmware_protocol.davis346.blocks import Block, blocks_of
from firmware_protocol.davis346.marks import Marks, no_marks
from firmware_protocol.davis346.words import Special
from firmware_protocol.events import Events
from firmware_protocol.frame_lines import LineKind, line_record
from firmware_protocol.imu_samples import ImuSamples, no_samples
from firmware_protocol.readings import ReadingKind, Readings

__all__ = ["DavisBatch", "davis_batches", "endless_davis_batches"]

_FRAME_US, _LINE_US, _SAMPLE_US = 40_000, 26, 1000
_COLUMNS, _ROWS = 346, 260


@dataclass(frozen=True)
class DavisBatch:
    """What falls into one stretch of stream time; all sorted by their times, us."""

    events: Events
    marks: Marks
    lines: Readings
    samples: ImuSamples

    @property
    def until_us(self) -> int:
        """Time of the last event."""
        return int(self.events["t"][-1])

    def blocks(self) -> list[Block]:
        """Return lines and samples as blocks in time order."""
        both = [*blocks_of(ReadingKind.FRAMES, self.lines), *blocks_of(ReadingKind.IMU, self.samples)]
        return sorted(both, key=lambda block: block.t_us)

    def later(self, by_us: int) -> DavisBatch:
        """Return the same, later."""
        parts = [part.copy() for part in (self.events, self.marks, self.lines, self.samples)]
        for part in parts:
            part["t"] += np.uint64(by_us)
        return DavisBatch(*parts)


def davis_batches(events: int, batch: int) -> list[DavisBatch]:
    """Return `events` events in batches of `batch`, with a frame each 40 ms, a sample and an edge each millisecond."""
    stream = saturated_stream(events)
    end_us = int(stream["t"][-1]) + 1
    lines = np.concatenate([_frame(start_us) for start_us in range(10, end_us, _FRAME_US)])
    samples, marks = no_samples(end_us // _SAMPLE_US), no_marks(end_us // _SAMPLE_US)
    samples["t"], samples["scale"] = _SAMPLE_US * np.arange(len(samples)) + 999, 0xE5
    samples["counts"] = np.random.default_rng(346).integers(-500, 500, (len(samples), 7))
    marks["t"], marks["code"] = _SAMPLE_US * np.arange(len(marks)) + 500, int(Special.INPUT_RISING)
    edges = [int(stream["t"][at]) for at in range(batch, len(stream), batch)]
    cuts = [_cut(part, edges) for part in (stream, marks, lines, samples)]
    return [DavisBatch(*parts) for parts in zip(*cuts, strict=True)]


def endless_davis_batches(events: int, batch: int) -> Iterator[DavisBatch]:
    """Yield the same again and again; `events` a multiple of half a million, that frames follow one another."""
    rounds = davis_batches(events, batch)
    span_us = rounds[-1].until_us + 1
    for number in count():
        for part in rounds:
            yield part.later(number * span_us)


def _cut(part: Readings, edges_us: list[int]) -> list[Readings]:
    return np.split(part, np.searchsorted(part["t"], edges_us))


def _frame(start_us: int) -> Readings:
    kinds = [LineKind.START, *[LineKind.RESET] * _COLUMNS, LineKind.EXPOSURE_START, LineKind.EXPOSURE_END]
    kinds += [*[LineKind.SIGNAL] * _COLUMNS, LineKind.END]
    lines = np.zeros(len(kinds), line_record(_COLUMNS))
    lines["t"], lines["kind"] = start_us + _LINE_US * np.arange(len(kinds)), kinds
    lines["exposure"], lines["global_shutter"], lines["roi"] = 120_000, True, (0, 0, _COLUMNS - 1, _ROWS - 1)
    of_pixels = np.isin(lines["kind"], (LineKind.RESET, LineKind.SIGNAL))
    lines["length"][of_pixels] = _ROWS
    lines["samples"] = np.random.default_rng(346).integers(400, 1000, lines["samples"].shape)
    return lines
