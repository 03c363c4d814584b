"""Whole frames from the lines that were delivered, in the user's picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from firmware_protocol.frame_lines import LineKind
from firmware_protocol.readings import Reading, ReadingKind, Readings

__all__ = ["FrameAssembler", "WholeFrame"]

Samples = npt.NDArray[np.uint16]


@dataclass(frozen=True)
class WholeFrame:
    """A frame that was delivered whole; times are stream time, us.

    Attributes
    ----------
    first_column, first_row
        Where its region begins in the array.
    reset, signal
        (rows, columns) uint16, ADC values.
    records
        Lines and moments that it was made of.
    """

    start_us: int
    exposure_start_us: int
    exposure_end_us: int
    end_us: int
    first_column: int
    first_row: int
    reset: Samples
    signal: Samples
    records: int = 0

    @property
    def pixels(self) -> Samples:
        """(rows, columns) uint16, 0 to 1023: brightness; what is saturated is 1023, as hosts have it."""
        value = np.clip(self.reset.astype(np.int32) - self.signal, 0, 1023)
        return np.where((self.reset < 384) | (self.signal == 0), 1023, value).astype(np.uint16)


class FrameAssembler:
    """Takes readings in the order of delivery; those of other kinds are skipped, and so are frames with gaps."""

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


def _whole(told: Readings) -> list[WholeFrame]:
    """Return the frame of its lines and moments; none where one is missing."""
    left, top, right, bottom = told["roi"][0].tolist()
    rows, columns = bottom - top + 1, right - left + 1
    by_kind = {kind: told[told["kind"] == kind] for kind in LineKind}
    moments = [by_kind[kind] for kind in LineKind if kind not in (LineKind.RESET, LineKind.SIGNAL)]
    lines = [by_kind[LineKind.RESET], by_kind[LineKind.SIGNAL]]
    if any(len(one) != 1 for one in moments) or not all(len(one) in (rows, columns) for one in lines):
        return []
    length = int(lines[0]["length"][0])
    reads = [one["samples"][:, :length] for one in lines]
    if any(read.shape != reads[0].shape for read in reads) or reads[0].size != rows * columns:
        return []
    by_column = told["by_column"][0]
    reset, signal = (np.ascontiguousarray(read.T if by_column else read) for read in reads)
    start, opened, shut, end = (int(one["t"][0]) for one in moments)
    return [WholeFrame(start, opened, shut, end, left, top, reset, signal, len(told))]
