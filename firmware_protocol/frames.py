"""Frames: records of a frame's lines and boundaries, the host's settings, and the assembly of whole frames.

A chip reads a frame as a sequence of lines and moments, each with its time:

    global shutter    START  RESET x n  EXPOSURE_START  EXPOSURE_END  SIGNAL x n  END
    rolling shutter   START  RESET and SIGNAL lines by time, the exposure's two moments with the first line  END

A record: t u64 us | kind u8 (LineKind) | line u16, in the user's coordinates | exposure u32, ADC cycles |
global_shutter bool | by_column bool | roi u16[4], first column, first row, last column, last row | length u16 |
samples u16[most], ADC values.

`FrameAssembler` makes whole frames, in the user's coordinates, of the lines that were delivered.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from firmware_protocol.device.items import Reading, ReadingKind, Readings
from firmware_protocol.events import UInt16s


class LineKind(IntEnum):
    """Kind of a record; lines have samples, moments have none."""

    START = 0
    RESET = 1
    EXPOSURE_START = 2
    EXPOSURE_END = 3
    SIGNAL = 4
    END = 5


def line_record(samples: int) -> np.dtype[Any]:
    """Return the dtype of a line of at most `samples` samples."""
    return np.dtype(
        [
            ("t", "<u8"), ("kind", "u1"), ("line", "<u2"), ("exposure", "<u4"), ("global_shutter", "?"),
            ("by_column", "?"), ("roi", "<u2", (4,)), ("length", "<u2"), ("samples", "<u2", (samples,)),
        ]
    )  # fmt: skip


@dataclass(frozen=True)
class FrameSettings:
    """Frame settings in the host's registers.

    Attributes
    ----------
    run : True if frames are requested now.
    global_shutter : True if all pixels are exposed at the same time.
    by_column : True if a line of the read-out is a column of the user's image; else a row.
    exposure_cycles : value of the register, for the stream.
    exposure_ns, interval_ns
        Stream time; the interval from one frame's start to the next, at least as long as a frame takes.
    first_column, first_row, last_column, last_row : region of interest in the user's coordinates, inclusive.
    """

    run: bool = False
    global_shutter: bool = True
    by_column: bool = False
    exposure_cycles: int = 0
    exposure_ns: int = 0
    interval_ns: int = 0
    first_column: int = 0
    first_row: int = 0
    last_column: int = 0
    last_row: int = 0

    @classmethod
    def of(cls, numbers: tuple[int, ...]) -> FrameSettings:
        """Return the settings from the numbers of `EventDevice.reading_settings`; no numbers: no frames."""
        return cls(*(bool(n) for n in numbers[:3]), *numbers[3:]) if numbers else cls()

    @property
    def roi(self) -> tuple[int, int, int, int]:
        """First column, first row, last column, last row."""
        return self.first_column, self.first_row, self.last_column, self.last_row


def brightness(reset: Any, signal: Any) -> UInt16s:
    """Return two reads, arrays of ADC values, as brightness, 0 to 1023; saturated pixels are 1023, as in hosts."""
    value = np.clip(reset.astype(np.int32) - signal, 0, 1023)
    return np.where((reset < 384) | (signal == 0), 1023, value).astype(np.uint16)


@dataclass(frozen=True)
class WholeFrame:
    """A frame that was delivered complete; times are stream time, us.

    Attributes
    ----------
    origin : column and row of its first pixel in the array.
    reset, signal : (rows, columns) uint16, ADC values.
    records : number of its lines and moments.
    """

    start_us: int
    exposure_start_us: int
    exposure_end_us: int
    end_us: int
    origin: tuple[int, int]
    reset: UInt16s
    signal: UInt16s
    records: int = 0


class FrameAssembler:
    """Assembler of frames from readings in the order of delivery; it skips other kinds, and frames with gaps."""

    def __init__(self) -> None:
        self._lines: list[Readings] = []

    def add(self, readings: tuple[Reading, ...]) -> list[WholeFrame]:
        """Return the frames that these readings complete."""
        frames = []
        for reading in readings:
            if reading.kind is not ReadingKind.FRAMES:
                continue
            kind = int(reading.record["kind"][0])
            self._lines = [] if kind == LineKind.START else self._lines
            self._lines.append(reading.record)
            if kind == LineKind.END:
                frames += _whole(np.concatenate(self._lines))
                self._lines = []
        return frames


def _whole(records: Readings) -> list[WholeFrame]:
    """Return the frame of its lines and moments; none if one is missing."""
    left, top, right, bottom = records["roi"][0].tolist()
    rows, columns = bottom - top + 1, right - left + 1
    by_kind = {kind: records[records["kind"] == kind] for kind in LineKind}
    moments = [by_kind[kind] for kind in LineKind if kind not in (LineKind.RESET, LineKind.SIGNAL)]
    lines = [by_kind[LineKind.RESET], by_kind[LineKind.SIGNAL]]
    if any(len(moment) != 1 for moment in moments) or not all(len(line) in (rows, columns) for line in lines):
        return []
    length = int(lines[0]["length"][0])
    reads = [line["samples"][:, :length] for line in lines]
    if any(read.shape != reads[0].shape for read in reads) or reads[0].size != rows * columns:
        return []
    by_column = records["by_column"][0]
    reset, signal = (np.ascontiguousarray(read.T if by_column else read) for read in reads)
    start, opened, shut, end = (int(moment["t"][0]) for moment in moments)
    return [WholeFrame(start, opened, shut, end, (left, top), reset, signal, len(records))]
