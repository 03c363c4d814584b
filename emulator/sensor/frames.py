"""Frames of a run: light and the host's settings in, lines with their times out.

A frame takes the settings of its start. The first one starts at the end of the step in which the host switched frames
on, later ones an interval after the one before, or when that one is done. Switching frames off ends the present one.

Timing of a frame:

    global shutter    reset reads, line after line | exposure of all | signal reads, line after line
    rolling shutter   reset and signal reads take turns; the signal read of a line comes as many turns after its reset
                      read as make up the exposure, so an exposure is a multiple of the time of two lines, at least one

A line is the result of one read of the chip: a column of the chip's frame, which is a row of the user's image where the
chip is mounted turned, as it is in the hardware. Source of the order: one recording; see `row_kicks`.

The exposure of each pixel is the integral over its light, on a straight line between two light frames. The converter
makes samples from it, with their noise:

    reset read   R + n1                                   R: the reset level; n1, n2: half of the read noise each
    signal read  R - (electrons / e + pattern) + n2       electrons: Poisson; e: electrons per DN

Both are rounded and cut to 0..1023. Every random number is keyed by the pixel and the frame's start, so that a frame
does not depend on the steps in which it was exposed. Photons: mean + sqrt(mean) z + (z^2 - 1) / 6, which has a Poisson
number's first three moments but for its rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.light import Light, LightFrame
from emulator.sensor.numerics.keyed import Purpose, normal, normals, root_of, streams
from emulator.sensor.parameters import FrameParameters
from emulator.sensor.row_kicks import LineReads
from firmware_protocol.device.items import ReadingKind, Readings
from firmware_protocol.events import Bytes, Float32s, Floats, Int64s, UInt16s
from firmware_protocol.frames import FrameSettings, LineKind, line_record

_MOST = 1023


class Converter:
    """The converter of a chip.

    Parameters
    ----------
    size : (width, height) of the array.
    by_column : true: a line is a column of the user's image; all arrays of lines are (lines, samples).
    """

    def __init__(self, parameters: FrameParameters, seed: int, size: tuple[int, int], by_column: bool) -> None:
        self._parameters = p = parameters
        self._seed = seed
        width, height = size
        pixels, columns = width * height, np.arange(width)
        fixed = p.column_pattern_dn * (1 - 2 * (columns % 2))
        fixed = fixed + p.column_fixed_dn * normal(seed, Purpose.APS_COLUMN, columns)
        gain = 1 + p.gain_spread * normal(seed, Purpose.APS_GAIN, np.arange(pixels)).reshape(height, width)
        self._by_column = by_column
        self._fixed = self._lines(np.broadcast_to(fixed.astype(np.float32), (height, width)))
        self._gain = self._lines(np.maximum(gain, 0).astype(np.float32))
        self._streams = {
            purpose: self._lines(streams(root_of(seed, purpose), pixels).reshape(height, width))
            for purpose in (Purpose.APS_RESET_NOISE, Purpose.APS_SIGNAL_NOISE, Purpose.APS_SHOT_NOISE)
        }

    def _lines(self, picture: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.ascontiguousarray(picture.T if self._by_column else picture)

    def reset(self, lines: slice, samples: slice, frame: int) -> UInt16s:
        """Return the reset reads of a part of the array, (lines, samples), of the frame whose number is `frame`."""
        return _converted(self._parameters.reset_dn + self._read_noise(Purpose.APS_RESET_NOISE, lines, samples, frame))

    def signal(self, light_ms: Float32s, lines: slice, samples: slice, frame: int) -> UInt16s:
        """Return the signal reads of a part after the exposure `light_ms`, (lines, samples) float32."""
        p = self._parameters
        brightness = light_ms * self._gain[lines, samples] * np.float32(p.sensitivity_dn_ms)
        if p.electrons_per_dn:
            brightness = self._photons(brightness, self._normals(Purpose.APS_SHOT_NOISE, lines, samples, frame))
        brightness += self._fixed[lines, samples]
        brightness += self._common_noise(lines, samples, frame)
        return _converted(p.reset_dn - brightness + self._read_noise(Purpose.APS_SIGNAL_NOISE, lines, samples, frame))

    def _photons(self, brightness: Float32s, z: Float32s) -> Float32s:
        """Return brightness, DN, with its shot noise; zero without light."""
        e = np.float32(self._parameters.electrons_per_dn)
        mean = brightness * e
        electrons = mean + np.sqrt(mean) * z + np.where(mean > 0, (z * z - 1) / 6, 0)
        return np.asarray(np.maximum(electrons, 0) / e)

    def _read_noise(self, purpose: Purpose, lines: slice, samples: slice, frame: int) -> Float32s:
        rms = self._parameters.read_noise_dn / math.sqrt(2)
        if not rms:
            return np.zeros(self._fixed[lines, samples].shape, np.float32)
        return self._normals(purpose, lines, samples, frame) * np.float32(rms)

    def _normals(self, purpose: Purpose, lines: slice, samples: slice, frame: int) -> Float32s:
        part = np.ascontiguousarray(self._streams[purpose][lines, samples])
        return np.asarray(normals(part.reshape(-1), frame).reshape(part.shape))

    def _common_noise(self, lines: slice, samples: slice, frame: int) -> Float32s:
        """Return the noise of columns and rows, which broadcasts to (lines, samples)."""
        p = self._parameters
        of_lines, of_samples = (p.column_noise_dn, p.row_noise_dn)[:: 1 if self._by_column else -1]
        names = (Purpose.APS_COLUMN_NOISE, Purpose.APS_ROW_NOISE)[:: 1 if self._by_column else -1]
        along = of_lines * normal(self._seed, names[0], np.arange(lines.start, lines.stop), frame)
        across = of_samples * normal(self._seed, names[1], np.arange(samples.start, samples.stop), frame)
        return (along[:, None] + across).astype(np.float32)


def _converted(level: Float32s) -> UInt16s:
    return np.asarray(np.clip(np.floor(level + np.float32(0.5)), 0, _MOST).astype(np.uint16))


def _weighed(weights: Floats, light: Light) -> Light:
    """Return (lines, samples) of light, negative as 0, times (lines,) of weights."""
    return np.asarray(np.maximum(light, 0) * weights.astype(np.float32)[:, None])


_SAMPLES = 346  # that `line_us` is for


@dataclass(frozen=True)
class FrameTimes:
    """A frame's moments, ns of stream time; arrays are (lines,).

    Attributes
    ----------
    reset_ns, signal_ns : start of the reads of each line; each takes `line_ns`.
    open_ns, shut_ns : exposure of each line.
    """

    start_ns: int
    line_ns: int
    reset_ns: Int64s
    open_ns: Int64s
    shut_ns: Int64s
    signal_ns: Int64s

    @property
    def end_ns(self) -> int:
        """End of the last read, ns."""
        return int(self.signal_ns[-1]) + self.line_ns


def _schedule(times: FrameTimes) -> tuple[Int64s, Bytes, Int64s]:
    """Return a frame's lines and moments in the order of their readings: times (n,) us, `LineKind` (n,), line (n,).

    A line has its reading when its read is done, in whole us from then on.
    """
    lines = np.arange(len(times.reset_ns))
    records = (
        (LineKind.START, [times.start_ns], [0]),
        (LineKind.RESET, times.reset_ns + times.line_ns, lines),
        (LineKind.EXPOSURE_START, times.open_ns[:1], [0]),
        (LineKind.EXPOSURE_END, times.shut_ns[:1], [0]),
        (LineKind.SIGNAL, times.signal_ns + times.line_ns, lines),
        (LineKind.END, [times.end_ns], [0]),
    )
    t_ns = np.concatenate([np.asarray(t, np.int64) for _, t, _ in records])
    kinds = np.concatenate([np.full(len(t), kind, np.uint8) for kind, t, _ in records])
    line = np.concatenate([np.asarray(lines, np.int64) for *_, lines in records])
    order = np.argsort(t_ns, kind="stable")
    return -(-t_ns[order] // 1000), kinds[order], line[order]


def frame_times(start_ns: int, settings: FrameSettings, line_us: float) -> FrameTimes:
    """Return the timing of a frame that starts at `start_ns`."""
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


_READ = "t_ns", "line", "signal", "frame"
_LEAST_INTERVAL_NS = 1_000_000  # a host can request one pixel without exposure: that would be millions of frames


class _Frame:
    """A frame in the making."""

    def __init__(
        self, start_ns: int, settings: FrameSettings, converter: Converter, parameters: FrameParameters
    ) -> None:
        self.settings = settings
        self.times = frame_times(start_ns, settings, parameters.line_us)
        self._kicks = parameters.kicks
        self._t_us, self._kinds, self._numbers = _schedule(self.times)
        self.returned = 0
        left, top, right, bottom = settings.roi
        rows, columns = slice(top, bottom + 1), slice(left, right + 1)
        self.lines, self.samples = (columns, rows) if settings.by_column else (rows, columns)
        shape = len(self.times.open_ns), self.samples.stop - self.samples.start
        self._light_ms = np.zeros(shape, np.float32)  # light times milliseconds so far
        self._converter = converter
        self._number = start_ns // 1000

    @property
    def done(self) -> bool:
        """All readings of the frame have been returned."""
        return self.returned == len(self._t_us)

    @property
    def reads(self) -> LineReads:
        """All its reads, at the times of their kicks."""
        times, kicks = self.times, self._kicks
        lines = np.arange(self.lines.start, self.lines.stop)
        signal = np.repeat([False, True], len(lines))
        reset_ns = times.reset_ns - round(kicks.reset_lead_us * 1000)
        t_ns = np.concatenate([reset_ns, times.signal_ns - round(kicks.signal_lead_us * 1000)])
        t_ns = np.maximum(t_ns, times.start_ns)  # the first kick of a frame lies in the step of its start
        frame = np.full(len(signal), self._number)
        return LineReads(t_ns, np.tile(lines, 2), signal, frame, self.settings.by_column)

    def expose(self, before: Light, t0_ns: int, after: Light, t1_ns: int) -> None:
        """Add the light of each line's exposure from `t0_ns` to `t1_ns`, with the light of the chip at both."""
        begin, end = np.maximum(self.times.open_ns, t0_ns), np.minimum(self.times.shut_ns, t1_ns)
        lit = np.flatnonzero(begin < end)
        if not len(lit):
            return
        part = slice(int(lit[0]), int(lit[-1]) + 1)  # lines open and shut in order, so there is no gap
        length_ms = (end[part] - begin[part]) * 1e-6
        middle = ((begin[part] + end[part]) / 2 - t0_ns) / (t1_ns - t0_ns)
        first, second = (light.T if self.settings.by_column else light for light in (before, after))
        lines = slice(self.lines.start + part.start, self.lines.start + part.stop), self.samples
        early, late = (1 - middle) * length_ms, middle * length_ms
        self._light_ms[part] += _weighed(early, first[lines]) + _weighed(late, second[lines])

    def read(self, until_us: int, record: np.dtype[Any]) -> Readings:
        """Return the readings until `until_us` that were not returned before."""
        upto = int(np.searchsorted(self._t_us, until_us, side="right"))
        part, self.returned = slice(self.returned, upto), upto
        records = np.zeros(upto - part.start, record)
        records["t"], records["kind"] = self._t_us[part], self._kinds[part]
        records["exposure"], records["global_shutter"] = self.settings.exposure_cycles, self.settings.global_shutter
        records["by_column"], records["roi"] = self.settings.by_column, self.settings.roi
        records["line"] = self._numbers[part] + self.lines.start
        for kind in (LineKind.RESET, LineKind.SIGNAL):
            self._convert(records, np.flatnonzero(records["kind"] == kind), kind)
        return records

    def _convert(self, records: Readings, at: npt.NDArray[np.intp], kind: LineKind) -> None:
        """Fill in the samples of the lines at `at`, of one kind: their numbers follow one another."""
        if not len(at):
            return
        lines = slice(int(records["line"][at[0]]), int(records["line"][at[-1]]) + 1)
        if kind is LineKind.RESET:
            values = self._converter.reset(lines, self.samples, self._number)
        else:
            exposed = slice(lines.start - self.lines.start, lines.stop - self.lines.start)
            values = self._converter.signal(self._light_ms[exposed], lines, self.samples, self._number)
        records["samples"][at, : values.shape[1]] = values
        records["length"][at] = values.shape[1]


class FrameSource:
    """The active pixels of a chip of `size` = (width, height).

    `disturb`: receiver of the reads that disturb each step, before the events of that step are made; None: none.
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

    def reset(self, frame: LightFrame) -> None:
        """Start at the time of `frame`."""
        self._converter(by_column=False).reset(slice(0, 1), slice(0, 1), 0)  # compiles
        self._before[:] = frame.light
        self._t_ns = self._before_ns = frame.t_ns
        self._frame = self._next_ns = None

    def read(self, frame: LightFrame, settings: tuple[int, ...]) -> Readings:
        """Move to the time of `frame` and return the lines that were read until then."""
        light, t_ns = frame.light, frame.t_ns
        requested = FrameSettings.of(settings)
        self._begun = []
        if not requested.run:
            self._frame = self._next_ns = None
            self._t_ns = t_ns
            return np.zeros(0, self.record)
        if self._next_ns is None:
            self._next_ns = self._t_ns if self._before_ns == self._t_ns else t_ns
        records = np.concatenate([np.zeros(0, self.record), *self._frames(light, t_ns, requested)])
        self._before[:] = light
        self._report_reads(t_ns)
        self._t_ns = self._before_ns = t_ns
        return records

    def _report_reads(self, t_ns: int) -> None:
        """Report the reads whose kicks come in the step to `t_ns`."""
        parts = [frame.reads.between(self._t_ns, t_ns) for frame in self._begun]
        if self._disturb is not None and parts:
            t, line, signal, frame = (np.concatenate([getattr(reads, name) for reads in parts]) for name in _READ)
            self._disturb(LineReads(t, line, signal, frame, parts[-1].by_column))

    def _frames(self, light: Light, t_ns: int, requested: FrameSettings) -> Iterator[Readings]:
        """Yield the readings of each frame until `t_ns`."""
        while self._frame is not None or (self._next_ns is not None and self._next_ns <= t_ns):
            if self._frame is None:
                converter = self._converter(by_column=requested.by_column)
                self._frame = _Frame(self._next_ns or 0, requested, converter, self._parameters)
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
