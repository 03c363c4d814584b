"""Inputs of a DAVIS346 beside events: the external input with detectors and generator, and the queue of readings.

Registers of module 4 (see `registers`), lengths in cycles of the logic clock:

    0 run detector   1 rising edges   2 falling edges   3 pulses   4 pulse polarity   5 pulse length
    11 run generator   12 polarity   13 interval   14 length   15, 16 report its rising, falling edges in the stream

Source: the published logic (SeeBetterLogic: ExtInputStateMachine.vhd, PulseDetector.vhd, PulseGenerator.vhd). A pulse
is reported once the signal has been at the pulse's polarity for the length, not when it ends. Detectors follow the
signal all the time; the run bit and the selections only decide which edges are reported. There is no debouncing.

An EDGE of kind RISING or FALLING sets the signal high or low. If the signal already has that level, the edge still
counts, because its source may report one side only. PULSE is both, `pulse_us` apart.

Readings on their way into the stream wait for their time, and for room if the camera waits on a stall:

    offer -> [waits for its time] -> stream -> host
                   ^-- no room --------+

The registers select the kinds that run. A frame whose start came while the camera did not run is left out as a whole,
because the host could not read it.

A frame's start, exposure and end always wait for room; its lines wait if the registers select it. If a frame's start
finds no room while parts of an earlier frame wait, the frame is left out as a whole, as in the published logic
(APSADCStateMachine: the next frame begins after the end of the one before). A slow host gets fewer frames, not frames
with gaps.
"""

from __future__ import annotations

import bisect
import heapq
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, replace

import numpy as np

from firmware_protocol.device.fates import Counts, Fates
from firmware_protocol.device.items import Numbers, ReadingKind, Readings, count_kinds
from firmware_protocol.events import EdgeKind, Edges, Int64s
from firmware_protocol.frames import FrameSettings, LineKind
from firmware_protocol.fx3.registers import Module, RegisterFile
from firmware_protocol.fx3.words import MARK, Block, Marks, Special, blocks_of, join_marks, no_marks
from firmware_protocol.imu_samples import ImuSettings


@dataclass(frozen=True)
class InputSettings:
    """Settings in the registers of the external input.

    Attributes
    ----------
    report_from_us : stream time from which marks are reported; None: the camera does not run.
    rising, falling, pulses : edges that the detector reports.
    active_high : polarity of a pulse.
    length_us : time after which a level is a pulse.
    generator : settings of the generator; None while it is off.
    """

    report_from_us: int | None = None
    rising: bool = False
    falling: bool = False
    pulses: bool = False
    active_high: bool = True
    length_us: int = 0
    generator: GeneratorSettings | None = None

    @classmethod
    def of(cls, values: RegisterFile, report_from_us: int | None) -> InputSettings:
        """Read the registers."""
        run, rising, falling, pulses, active_high, cycles = (values.read(Module.EXTERNAL_INPUT, k) for k in range(6))
        return cls(
            report_from_us,
            bool(run and rising),
            bool(run and falling),
            bool(run and pulses),
            bool(active_high),
            cycles // max(values.read(Module.SYSTEM, 3), 1),
            GeneratorSettings.of(values),
        )


@dataclass(frozen=True)
class GeneratorSettings:
    """A running generator: lengths in cycles of `clock_mhz`, and a selection of its edges to report."""

    clock_mhz: int
    active_high: bool
    interval: int
    length: int
    report_rising: bool
    report_falling: bool

    @classmethod
    def of(cls, values: RegisterFile) -> GeneratorSettings | None:
        """Read the registers; None if the generator is off or its output never changes."""
        run, high, interval, length, rising, falling = (values.read(Module.EXTERNAL_INPUT, k) for k in range(11, 17))
        if not run or not 0 < length < interval:
            return None
        return cls(max(values.read(Module.SYSTEM, 3), 1), bool(high), interval, length, bool(rising), bool(falling))

    def marks(self, since_us: int, after_us: int, until_us: int) -> Marks:
        """Return the marks after `after_us` and up to `until_us`; the generator started at `since_us`."""
        begins, ends = Special.GENERATOR_RISING, Special.GENERATOR_FALLING
        report_begin, report_end = self.report_rising, self.report_falling
        if not self.active_high:
            begins, ends = ends, begins
            report_begin, report_end = report_end, report_begin
        parts = []
        for code, reported, offset in ((begins, report_begin, 0), (ends, report_end, self.length)):
            if reported:
                times_us = self._times_us(offset, after_us - since_us, until_us - since_us)
                marks = no_marks(len(times_us))
                marks["t"] = times_us + since_us
                marks["code"] = int(code)
                parts.append(marks)
        return join_marks(parts)

    def _times_us(self, offset: int, after_us: int, until_us: int) -> Int64s:
        """Return the start (offset 0) or end times of pulses, us since the start, one in a microsecond at most."""
        first = max(1, -(-((after_us + 1) * self.clock_mhz - offset) // self.interval))
        last = (until_us * self.clock_mhz + self.clock_mhz - 1 - offset) // self.interval
        if self.interval <= self.clock_mhz:  # one in each microsecond: no need to compute a hundred cycles
            first_us, last_us = ((k * self.interval + offset) // self.clock_mhz for k in (first, last))
            return np.arange(first_us, last_us + 1, dtype=np.int64)
        cycles = np.arange(first, last + 1, dtype=np.int64) * self.interval + offset
        return cycles // self.clock_mhz


@dataclass
class _Cause:
    """An edge that was offered: number of marks it may still make, and of marks it made."""

    open: int
    marks: int = 0


class ExternalInput:
    """The signal and its detectors: `offer` takes edges, `marks` returns the marks of an interval of time.

    `pulse_us`: length of an EDGE of kind PULSE; `counts`: the camera's counts of edges.
    """

    def __init__(self, pulse_us: int, counts: Counts) -> None:
        self._pulse_us = pulse_us
        self._counts = counts
        self._changes: list[tuple[int, int, bool, _Cause]] = []
        self._number = 0
        self._level = False
        self._level_since_us = 0
        self._level_cause: _Cause | None = None
        self._generator: tuple[GeneratorSettings, int] | None = None
        self._reported: list[tuple[int, int]] = []

    @property
    def pending(self) -> int:
        """Edges that have made no mark yet, and still may."""
        unmarked = {id(cause) for _, _, _, cause in self._changes if not cause.marks}
        if self._level_cause is not None and not self._level_cause.marks:
            unmarked.add(id(self._level_cause))
        return len(unmarked)

    @property
    def expected(self) -> int:
        """Marks that the offered edges can still make."""
        return 2 * len(self._changes) + (self._level_cause is not None)

    def offer(self, edges: Edges, now_us: int) -> None:
        """Take edges (n,) EDGE in stream time; those before `now_us` are applied at `now_us`."""
        for t, kind in zip(np.maximum(edges["t"], now_us).tolist(), edges["kind"].tolist(), strict=True):
            if kind == EdgeKind.PULSE:
                cause = _Cause(2)
                self._change(t, True, cause)
                self._change(t + self._pulse_us, False, cause)
            else:
                self._change(t, kind == EdgeKind.RISING, _Cause(1))
        self._counts.offered += len(edges)

    def _change(self, t: int, level: bool, cause: _Cause) -> None:
        heapq.heappush(self._changes, (t, self._number, level, cause))
        self._number += 1

    def marks(self, after_us: int, until_us: int, settings: InputSettings) -> Marks:
        """Return the marks after `after_us` and up to `until_us`, (n,) MARK in stream time."""
        if not self._changes and self._level_cause is None and self._generator is None and settings.generator is None:
            return no_marks()
        while self._happen(after_us, until_us, settings):
            pass
        reported, self._reported = np.array(self._reported, MARK), []
        return join_marks([reported, self._generated(after_us, until_us, settings)])

    def _happen(self, after_us: int, until_us: int, settings: InputSettings) -> bool:
        """Apply the next change of the signal, or report a level that has lasted a pulse's length."""
        change_us = self._changes[0][0] if self._changes else None
        due_us = None if self._level_cause is None else self._level_since_us + settings.length_us
        if due_us is not None and due_us <= until_us and (change_us is None or due_us <= change_us):
            self._pulse(max(due_us, after_us), settings)
        elif change_us is not None and change_us <= until_us:
            _, _, level, cause = heapq.heappop(self._changes)
            self._step(change_us, level, cause, settings)
        else:
            return False
        return True

    def _step(self, at_us: int, level: bool, cause: _Cause, settings: InputSettings) -> None:
        self._close(self._level_cause)
        self._level = level
        self._level_since_us = at_us
        self._level_cause = None
        if settings.rising if level else settings.falling:
            self._report(at_us, Special.INPUT_RISING if level else Special.INPUT_FALLING, cause, settings)
        if level == settings.active_high:
            self._level_cause = cause
        else:
            self._close(cause)

    def _pulse(self, at_us: int, settings: InputSettings) -> None:
        cause, self._level_cause = self._level_cause, None
        if settings.pulses and self._level == settings.active_high and cause is not None:
            self._report(at_us, Special.INPUT_PULSE, cause, settings)
        self._close(cause)

    def _report(self, at_us: int, code: Special, cause: _Cause, settings: InputSettings) -> None:
        if settings.report_from_us is None or at_us < settings.report_from_us:
            return
        self._reported.append((at_us, int(code)))
        self._counts.added += cause.marks > 0
        cause.marks += 1

    def _close(self, cause: _Cause | None) -> None:
        """Count one of the possible effects of an edge as over."""
        if cause is not None:
            cause.open -= 1
            self._counts.ignored += cause.open == 0 and cause.marks == 0

    def _generated(self, after_us: int, until_us: int, settings: InputSettings) -> Marks:
        generator, report_from_us = settings.generator, settings.report_from_us
        if generator is None or report_from_us is None:
            self._generator = None
            return no_marks()
        if self._generator is None or self._generator[0] != generator:
            self._generator = (generator, after_us)
        marks = generator.marks(self._generator[1], max(after_us, report_from_us - 1), until_us)
        self._counts.added += len(marks)
        return marks


_MOST_SAMPLES = 16  # of the inertial unit, waiting for room
_LINES = (LineKind.RESET, LineKind.SIGNAL)
_IMU_WORDS = 1 + 17  # a timestamp, and a sample of all three groups


class ReadingInput(ABC):
    """Readings that were offered and are not in the stream yet, and their settings in the registers.

    A camera adds `follow`, which reads its registers: the settings, and `_lines_wait` if it takes frames.
    """

    def __init__(
        self, size: tuple[int, int], registers: RegisterFile, fates: Fates, *, has_frames: bool, has_imu: bool
    ) -> None:
        self._has_frames = has_frames
        self._has_imu = has_imu
        self._registers = registers
        self._longest = {ReadingKind.FRAMES: max(size) + 2, ReadingKind.IMU: _IMU_WORDS}
        self._frames = FrameSettings()
        self._imu = ImuSettings()
        self._waiting: list[Block] = []
        self._held: deque[Block] = deque()
        self._in_frame = self._left_out = False
        self._lines_wait = False
        self._fates = fates

    @abstractmethod
    def follow(self, *, words: bool) -> None:
        """Read the registers again; `words`: true while the data path runs."""

    def _blocks_of(self, kind: ReadingKind, readings: Readings) -> list[Block]:
        """Return readings of a kind, (n,), as blocks."""
        return blocks_of(kind, readings)

    def settings_of(self, kind: ReadingKind) -> tuple[int, ...]:
        """Return the settings of a kind; see `TakesReadings.reading_settings`."""
        settings = self._frames if kind is ReadingKind.FRAMES else self._imu
        return tuple(int(n) for n in astuple(settings)) if self.takes(kind) else ()

    def takes(self, kind: ReadingKind) -> bool:
        """Return true if the camera has this kind."""
        return self._has_frames if kind is ReadingKind.FRAMES else self._has_imu

    def runs(self, kind: ReadingKind) -> bool:
        """Return true if readings of a kind would go to the host now."""
        return self.takes(kind) and (self._frames.run if kind is ReadingKind.FRAMES else self._imu.run)

    def reserved(self, free_words: int) -> int:
        """Return the number of free words reserved for readings in a run that is not paced: half, if any kind runs."""
        return free_words // 2 if any(self.runs(kind) for kind in ReadingKind) else 0

    def room(self, kind: ReadingKind, free_words: int) -> int:
        """Return the number of readings of a kind that fit the reserved words."""
        waiting = sum(len(block.words) for block in (*self._held, *self._waiting))
        kinds = sum(self.runs(other) for other in ReadingKind)
        return max(0, (self.reserved(free_words) - waiting) // (self._longest[kind] * max(kinds, 1)))

    def offer(self, kind: ReadingKind, readings: Readings, from_us: int) -> None:
        """Take readings of a kind, (n,); those before `from_us` came while the camera did not run."""
        running = readings[readings["t"] >= from_us] if self.runs(kind) else readings[:0]
        blocks = self._blocks_of(kind, running)
        if kind is ReadingKind.FRAMES:
            self._in_frame = self._in_frame and len(blocks) == len(readings)
            blocks = [block for block in blocks if self._is_read(block)]
        self._fates.of(kind).offered += len(readings)
        self._fates.of(kind).not_running += len(readings) - len(blocks)
        self._waiting = sorted([*self._waiting, *blocks], key=_time_of)

    def _is_read(self, block: Block) -> bool:
        """Return true if a host can read this part of a frame: it has the frame's start, or will receive it."""
        self._in_frame = self._in_frame or _line_kind(block) == LineKind.START
        return self._in_frame

    def due(self, now_us: int, until_us: int, free_words: int) -> list[Block]:
        """Remove and return the blocks up to `until_us` that may fit `free_words`; the others are held.

        Those that waited beyond their time have that of `now_us`.
        """
        if not self._waiting and not self._held:
            return []
        count = bisect.bisect_right(self._waiting, until_us, key=_time_of)
        new, self._waiting = self._waiting[:count], self._waiting[count:]
        passed = deque[Block]()
        for block in new:
            part = _line_kind(block)
            self._left_out = self._left_out and part != LineKind.START
            if part is None or not self._left_out:
                passed.append(block)
        if len(passed) < len(new):
            self._fates.of(ReadingKind.FRAMES).dropped_fifo += len(new) - len(passed)
        due: list[Block] = []
        for queue in (self._held, passed):
            while queue and len(queue[0].words) <= free_words:
                free_words -= len(queue[0].words)
                due.append(queue.popleft())
            if queue:
                break
        self._hold(passed)
        for k, block in enumerate(due):
            if block.t_us < now_us:  # words and reading of a block that waited are both of `now_us`
                record = block.reading.record.copy()
                record["t"] = now_us
                due[k] = Block(now_us, block.words, replace(block.reading, record=record))
        return due

    def put_back(self, blocks: Sequence[Block]) -> None:
        """Put blocks that were due back into the queue."""
        self._held.extendleft(reversed(blocks))

    def hold(self, late: Sequence[Block]) -> None:
        """Put blocks that found no room back into the queue if they may wait; drop the others."""
        if late:
            blocks, self._held = [*late, *self._held], deque()
            self._hold(blocks)

    def _hold(self, blocks: Iterable[Block]) -> None:
        """Queue blocks behind those that wait: parts of one frame only, without lines that may not wait."""
        held = Counter(block.reading.kind for block in self._held) if blocks else Counter()
        left_out = False
        for block in blocks:
            kind, part = block.reading.kind, _line_kind(block)
            if part == LineKind.START:
                left_out = held[kind] > 0
                self._left_out = self._left_out or left_out
            if part is None:
                waits = held[kind] < _MOST_SAMPLES
            else:
                waits = not left_out and (self._lines_wait or part not in _LINES)
            if waits:
                self._held.append(block)
            held[kind] += waits
            self._fates.of(kind).dropped_fifo += not waits

    def flush(self) -> None:
        """Drop the blocks that wait."""
        self._fates.drop(self.waiting)
        self._held, self._waiting = deque(), []
        self._in_frame = False

    @property
    def waiting(self) -> Numbers:
        """Numbers of readings that were offered and are not in the stream."""
        if not self._held and not self._waiting:
            return Numbers()
        return Numbers(readings=count_kinds([block.reading for block in (*self._held, *self._waiting)]))


def _time_of(block: Block) -> int:
    return block.t_us


def _line_kind(block: Block) -> int | None:
    """Return the `LineKind` of a part of a frame; None for a sample."""
    return int(block.reading.record["kind"][0]) if block.reading.kind is ReadingKind.FRAMES else None
