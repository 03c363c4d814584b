"""When what happens in a frame.

    global shutter    reset reads, line after line | exposure of all | signal reads, line after line
    rolling shutter   reset and signal reads take turns; the signal read of a line comes as many turns after its reset
                      read as make up the exposure, so an exposure is a multiple of the time of two lines, at least one

A line is what one read of the chip gives: a column of the chip's frame, which is a row of the user's picture where the
chip lies turned, as it does in the hardware. Source of the order: one recording; see `parameters`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from firmware_protocol.frame_lines import FrameSettings, LineKind

__all__ = ["FrameTimes", "Schedule", "frame_times"]

_SAMPLES = 346  # that `line_us` is for

Times = npt.NDArray[np.int64]


@dataclass(frozen=True)
class FrameTimes:
    """A frame's moments, ns of stream time; arrays are (lines,).

    Attributes
    ----------
    reset_ns, signal_ns
        When the reads of each line begin; each takes `line_ns`.
    open_ns, shut_ns
        Exposure of each line.
    """

    start_ns: int
    line_ns: int
    reset_ns: Times
    open_ns: Times
    shut_ns: Times
    signal_ns: Times

    @property
    def end_ns(self) -> int:
        """When the last read is done."""
        return int(self.signal_ns[-1]) + self.line_ns


@dataclass(frozen=True)
class Schedule:
    """A frame's lines and moments in the order in which they are told: times (n,) us, `LineKind` (n,), line (n,)."""

    t_us: Times
    kind: npt.NDArray[np.uint8]
    line: Times

    @classmethod
    def of(cls, times: FrameTimes) -> Schedule:
        """Return that of a frame; a line is told when its read is done, in whole us from then on."""
        lines = np.arange(len(times.reset_ns))
        told = (
            (LineKind.START, [times.start_ns], [0]),
            (LineKind.RESET, times.reset_ns + times.line_ns, lines),
            (LineKind.EXPOSURE_START, times.open_ns[:1], [0]),
            (LineKind.EXPOSURE_END, times.shut_ns[:1], [0]),
            (LineKind.SIGNAL, times.signal_ns + times.line_ns, lines),
            (LineKind.END, [times.end_ns], [0]),
        )
        t_ns = np.concatenate([np.asarray(t, np.int64) for _, t, _ in told])
        kinds = np.concatenate([np.full(len(t), kind, np.uint8) for kind, t, _ in told])
        line = np.concatenate([np.asarray(which, np.int64) for *_, which in told])
        order = np.argsort(t_ns, kind="stable")
        return cls(-(-t_ns[order] // 1000), kinds[order], line[order])


def frame_times(start_ns: int, settings: FrameSettings, line_us: float) -> FrameTimes:
    """Return when what happens in a frame that starts at `start_ns`."""
    left, top, right, bottom = settings.roi
    shape = (bottom - top + 1, right - left + 1)
    lines, samples = shape[::-1] if settings.by_column else shape
    line_ns = max(1, round(line_us * 1000 * samples / _SAMPLES))
    numbers = np.arange(lines, dtype=np.int64)
    if settings.global_shutter:
        reset = start_ns + numbers * line_ns
        opened = np.full(lines, start_ns + lines * line_ns, np.int64)
        shut = opened + settings.exposure_ns
        return FrameTimes(start_ns, line_ns, reset, opened, shut, shut + numbers * line_ns)
    turns = max(1, round(settings.exposure_ns / (2 * line_ns)))
    reset = start_ns + 2 * numbers * line_ns
    opened = reset + line_ns
    shut = opened + 2 * turns * line_ns
    return FrameTimes(start_ns, line_ns, reset, opened, shut, shut)
