"""A frame as its chip reads it: a sequence of lines and moments, each with its time; and what a host asks of frames.

    global shutter    START  RESET x n  EXPOSURE_START  EXPOSURE_END  SIGNAL x n  END
    rolling shutter   START  RESET and SIGNAL lines by time, the exposure's two moments with the first line  END

A record: t u64 us | kind u8 (LineKind) | line u16, in the user's frame | exposure u32, ADC cycles | global_shutter bool
| by_column bool | roi u16[4], first column, first row, last column, last row | length u16 | samples u16[most], ADC
values.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

__all__ = ["FrameSettings", "LineKind", "line_record"]


class LineKind(IntEnum):
    """What a record tells of; lines have samples, moments have none."""

    START = 0
    RESET = 1
    EXPOSURE_START = 2
    EXPOSURE_END = 3
    SIGNAL = 4
    END = 5


def line_record(most: int) -> np.dtype[Any]:
    """Return the dtype of a line of at most `most` samples."""
    return np.dtype(
        [
            ("t", "<u8"), ("kind", "u1"), ("line", "<u2"), ("exposure", "<u4"), ("global_shutter", "?"),
            ("by_column", "?"), ("roi", "<u2", (4,)), ("length", "<u2"), ("samples", "<u2", (most,)),
        ]
    )  # fmt: skip


@dataclass(frozen=True)
class FrameSettings:
    """What the host's registers ask of frames.

    Attributes
    ----------
    run
        Whether frames are wanted now.
    global_shutter
        Whether all pixels are exposed at the same time.
    by_column
        Whether a line of the read-out is a column of the user's picture; else a row.
    exposure_cycles
        As the register has it, for the stream.
    exposure_ns, interval_ns
        Stream time; the interval from one frame's start to the next, at least as long as a frame takes.
    first_column, first_row, last_column, last_row
        Region of interest in the user's frame, inclusive.
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
        """Return them from the numbers of `EventDevice.reading_settings`; no numbers: no frames."""
        return cls(*(bool(n) for n in numbers[:3]), *numbers[3:]) if numbers else cls()

    @property
    def roi(self) -> tuple[int, int, int, int]:
        """First column, first row, last column, last row."""
        return self.first_column, self.first_row, self.last_column, self.last_row
