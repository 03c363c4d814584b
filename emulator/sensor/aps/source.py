"""Frames of a run: light and the host's settings in, lines with their times out.

A frame takes the settings of its start. The first one starts at the end of the step in which the host switched frames
on, later ones an interval after the one before, or when that one is done. Switching frames off ends the present one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.light import Light
from emulator.sensor.aps.conversion import Converter
from emulator.sensor.aps.exposure import Exposure
from emulator.sensor.aps.parameters import FrameParameters
from emulator.sensor.aps.row_kicks import LineReads
from emulator.sensor.aps.timeline import Schedule, frame_times
from firmware_protocol.frame_lines import FrameSettings, LineKind, line_record
from firmware_protocol.readings import ReadingKind, Readings

__all__ = ["FrameSource"]

_READ = "t_ns", "line", "signal"
_LEAST_INTERVAL_NS = 1_000_000  # a host can ask for one pixel without exposure: that would be millions of frames


class _Frame:
    """A frame in the making."""

    def __init__(self, start_ns: int, settings: FrameSettings, converter: Converter, line_us: float) -> None:
        self.settings = settings
        self.times = frame_times(start_ns, settings, line_us)
        self.schedule = Schedule.of(self.times)
        self.told = 0
        left, top, right, bottom = settings.roi
        rows, columns = slice(top, bottom + 1), slice(left, right + 1)
        self.lines, self.samples = (columns, rows) if settings.by_column else (rows, columns)
        self.exposure = Exposure(self.times.open_ns, self.times.shut_ns, self.samples.stop - self.samples.start)
        self._converter = converter
        self._number = start_ns // 1000

    @property
    def done(self) -> bool:
        """Whether all of it was told."""
        return self.told == len(self.schedule.t_us)

    @property
    def reads(self) -> LineReads:
        """All its reads."""
        times, lines = self.times, np.arange(self.lines.start, self.lines.stop)
        signal = np.repeat([False, True], len(lines))
        t_ns = np.concatenate([times.reset_ns, times.signal_ns])
        return LineReads(t_ns, np.tile(lines, 2), signal, self.settings.by_column)

    def expose(self, before: Light, t0_ns: int, after: Light, t1_ns: int) -> None:
        """Add the light from `t0_ns` to `t1_ns`."""
        first, second = (light.T if self.settings.by_column else light for light in (before, after))
        part = self.lines, self.samples
        self.exposure.add(first[part], t0_ns, second[part], t1_ns)

    def read(self, until_us: int, record: np.dtype[Any]) -> Readings:
        """Return what is told until `until_us` and was not before."""
        upto = int(np.searchsorted(self.schedule.t_us, until_us, side="right"))
        part, self.told = slice(self.told, upto), upto
        told = np.zeros(upto - part.start, record)
        told["t"], told["kind"] = self.schedule.t_us[part], self.schedule.kind[part]
        told["exposure"], told["global_shutter"] = self.settings.exposure_cycles, self.settings.global_shutter
        told["by_column"], told["roi"] = self.settings.by_column, self.settings.roi
        told["line"] = self.schedule.line[part] + self.lines.start
        for kind in (LineKind.RESET, LineKind.SIGNAL):
            self._convert(told, np.flatnonzero(told["kind"] == kind), kind)
        return told

    def _convert(self, told: Readings, at: npt.NDArray[np.intp], kind: LineKind) -> None:
        """Fill in the samples of the lines at `at`, of one kind: their numbers follow one another."""
        if not len(at):
            return
        lines = slice(int(told["line"][at[0]]), int(told["line"][at[-1]]) + 1)
        if kind is LineKind.RESET:
            values = self._converter.reset(lines, self.samples, self._number)
        else:
            own = slice(lines.start - self.lines.start, lines.stop - self.lines.start)
            values = self._converter.signal(self.exposure.light_ms[own], lines, self.samples, self._number)
        told["samples"][at, : values.shape[1]] = values
        told["length"][at] = values.shape[1]


class FrameSource:
    """The active pixels of a chip of `size` = (width, height).

    Parameters
    ----------
    disturb
        Is told of the reads that begin in each step, before the events of that step are made; None: nobody is.
    """

    kind = ReadingKind.FRAMES

    def __init__(
        self,
        parameters: FrameParameters,
        seed: int,
        size: tuple[int, int],
        disturb: Callable[[LineReads], None] | None = None,
    ) -> None:
        self._disturb = disturb
        self._begun: list[_Frame] = []
        self.record = line_record(max(size))
        self._parameters = parameters
        self._seed = seed
        self._size = size
        self._converters: dict[bool, Converter] = {}
        self._before = np.zeros(size[::-1], np.float32)
        self._t_ns = self._before_ns = 0
        self._frame: _Frame | None = None
        self._next_ns: int | None = None

    def reset(self, light: Light, t_ns: int) -> None:
        """Start at `t_ns` on `light`, (height, width) float32."""
        self._converter(by_column=False).reset(slice(0, 1), slice(0, 1), 0)  # compiles
        self._before[:] = light
        self._t_ns = self._before_ns = t_ns
        self._frame = self._next_ns = None

    def read(self, light: Light, t_ns: int, settings: tuple[int, ...]) -> Readings:
        """Move to `t_ns`, when the light is `light`; return the lines that were read until then."""
        asked = FrameSettings.of(settings)
        told = np.zeros(0, self.record)
        self._begun = []
        if not asked.run:
            self._frame = self._next_ns = None
            self._t_ns = t_ns
            return told
        if self._next_ns is None:
            self._next_ns = self._t_ns if self._before_ns == self._t_ns else t_ns
        told = np.concatenate([told, *self._frames(light, t_ns, asked)])
        self._before[:] = light
        self._tell_reads(t_ns)
        self._t_ns = self._before_ns = t_ns
        return told

    def _tell_reads(self, t_ns: int) -> None:
        """Tell of the reads that begin in the step to `t_ns`."""
        parts = [frame.reads.between(self._t_ns, t_ns) for frame in self._begun]
        if self._disturb is not None and parts:
            t, line, signal = (np.concatenate([getattr(one, name) for one in parts]) for name in _READ)
            self._disturb(LineReads(t, line, signal, parts[-1].by_column))

    def _frames(self, light: Light, t_ns: int, asked: FrameSettings) -> Iterator[Readings]:
        """Yield what is told of each frame until `t_ns`."""
        while self._frame is not None or (self._next_ns is not None and self._next_ns <= t_ns):
            if self._frame is None:
                converter = self._converter(by_column=asked.by_column)
                self._frame = _Frame(self._next_ns or 0, asked, converter, self._parameters.line_us)
            frame = self._frame
            self._begun.append(frame)
            if self._before_ns == self._t_ns:
                frame.expose(self._before, self._t_ns, light, t_ns)
            yield frame.read(t_ns // 1000, self.record)
            if not frame.done:
                return
            interval_ns = max(frame.settings.interval_ns, _LEAST_INTERVAL_NS)
            self._next_ns = max(frame.times.start_ns + interval_ns, frame.times.end_ns)
            self._frame = None

    def _converter(self, *, by_column: bool) -> Converter:
        if by_column not in self._converters:
            self._converters[by_column] = Converter(self._parameters, self._seed, self._size, by_column)
        return self._converters[by_column]
