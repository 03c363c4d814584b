"""The external input of a DAVIS346: its signal, the detectors that watch it, and the generator beside it.

Registers of module 4 (see `registers`), lengths in cycles of the logic clock:

    0 run detector   1 rising edges   2 falling edges   3 pulses   4 pulse polarity   5 pulse length
    11 run generator   12 polarity   13 interval   14 length   15, 16 tell of its rising, falling edges in the stream

Source: the published logic (SeeBetterLogic: ExtInputStateMachine.vhd, PulseDetector.vhd, PulseGenerator.vhd). A pulse
is told once the signal has been at the pulse's polarity for the length, not when it ends. Detectors watch the signal
all the time; the run bit and the selections only decide what is told. There is no debouncing.

An EDGE of kind RISING or FALLING sets the signal high or low. One of the level that the signal has already counts as an
edge all the same: its source tells of one side only. PULSE is both, `pulse_us` apart.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from firmware_protocol.davis346.marks import MARK, Marks, join_marks, no_marks
from firmware_protocol.davis346.registers import Module, RegisterFile
from firmware_protocol.davis346.words import Special
from firmware_protocol.edges import EdgeKind, Edges

__all__ = ["ExternalInput", "InputSettings"]


@dataclass(frozen=True)
class InputSettings:
    """What the registers ask for.

    Attributes
    ----------
    told_from_us
        Stream time from which marks are told; None: the camera does not run.
    rising, falling, pulses
        What the detector tells.
    active_high
        Polarity of a pulse.
    length_us
        Time after which a level is a pulse.
    generator
        The generator's; None while it stands still.
    """

    told_from_us: int | None = None
    rising: bool = False
    falling: bool = False
    pulses: bool = False
    active_high: bool = True
    length_us: int = 0
    generator: GeneratorSettings | None = None

    @classmethod
    def of(cls, values: RegisterFile, told_from_us: int | None) -> InputSettings:
        """Read the registers."""
        run, rising, falling, pulses, active_high, cycles = (values.read(Module.EXTERNAL_INPUT, k) for k in range(6))
        return cls(
            told_from_us,
            bool(run and rising),
            bool(run and falling),
            bool(run and pulses),
            bool(active_high),
            cycles // max(values.read(Module.SYSTEM, 3), 1),
            GeneratorSettings.of(values),
        )


@dataclass(frozen=True)
class GeneratorSettings:
    """A running generator: lengths in cycles of `clock_mhz`, and which of its edges are told."""

    clock_mhz: int
    active_high: bool
    interval: int
    length: int
    tell_rising: bool
    tell_falling: bool

    @classmethod
    def of(cls, values: RegisterFile) -> GeneratorSettings | None:
        """Read the registers; None for a generator that stands still or whose output never changes."""
        run, high, interval, length, rising, falling = (values.read(Module.EXTERNAL_INPUT, k) for k in range(11, 17))
        if not run or not 0 < length < interval:
            return None
        return cls(max(values.read(Module.SYSTEM, 3), 1), bool(high), interval, length, bool(rising), bool(falling))

    def marks(self, since_us: int, after_us: int, until_us: int) -> Marks:
        """Return what it tells of after `after_us` and up to `until_us`; it started at `since_us`."""
        begins, ends = Special.GENERATOR_RISING, Special.GENERATOR_FALLING
        tell_begin, tell_end = self.tell_rising, self.tell_falling
        if not self.active_high:
            begins, ends, tell_begin, tell_end = ends, begins, tell_end, tell_begin
        parts = []
        for code, told, offset in ((begins, tell_begin, 0), (ends, tell_end, self.length)):
            if told:
                times_us = self._times_us(offset, after_us - since_us, until_us - since_us)
                parts.append(_marks_at(times_us + since_us, code))
        return join_marks(parts)

    def _times_us(self, offset: int, after_us: int, until_us: int) -> npt.NDArray[np.int64]:
        """Return when pulses begin (offset 0) or end, us since the start, one in any microsecond at most."""
        first = max(1, -(-((after_us + 1) * self.clock_mhz - offset) // self.interval))
        last = (until_us * self.clock_mhz + self.clock_mhz - 1 - offset) // self.interval
        if self.interval <= self.clock_mhz:  # one in each microsecond: a hundred cycles need not be looked at
            first_us, last_us = ((k * self.interval + offset) // self.clock_mhz for k in (first, last))
            return np.arange(first_us, last_us + 1, dtype=np.int64)
        cycles = np.arange(first, last + 1, dtype=np.int64) * self.interval + offset
        return cycles // self.clock_mhz


@dataclass
class _Cause:
    """An edge that was offered: what of it is still to come, and how many marks it made."""

    open: int
    marks: int = 0


class ExternalInput:
    """The signal and its detectors. Edges go in by `offer`, marks come out by `marks` as time goes on.

    Parameters
    ----------
    pulse_us
        Length of an EDGE of kind PULSE.
    """

    def __init__(self, pulse_us: int) -> None:
        self._pulse_us = pulse_us
        self._changes: list[tuple[int, int, bool, _Cause]] = []
        self._number = 0
        self._level = False
        self._level_since_us = 0
        self._level_cause: _Cause | None = None
        self._generator: tuple[GeneratorSettings, int] | None = None
        self._told: list[tuple[int, int]] = []
        self.offered = 0
        self.ignored = 0
        self.added = 0

    @property
    def pending(self) -> int:
        """Edges that made no mark so far, and still may."""
        unmarked = {id(cause) for _, _, _, cause in self._changes if not cause.marks}
        if self._level_cause is not None and not self._level_cause.marks:
            unmarked.add(id(self._level_cause))
        return len(unmarked)

    @property
    def expected(self) -> int:
        """Marks that the edges taken so far can still make."""
        return 2 * len(self._changes) + (self._level_cause is not None)

    def offer(self, edges: Edges, now_us: int) -> None:
        """Take edges (n,) EDGE in stream time; those before `now_us` happen then."""
        for t, kind in zip(np.maximum(edges["t"], now_us).tolist(), edges["kind"].tolist(), strict=True):
            if kind == EdgeKind.PULSE:
                cause = _Cause(2)
                self._change(t, True, cause)
                self._change(t + self._pulse_us, False, cause)
            else:
                self._change(t, kind == EdgeKind.RISING, _Cause(1))
        self.offered += len(edges)

    def _change(self, t: int, level: bool, cause: _Cause) -> None:
        heapq.heappush(self._changes, (t, self._number, level, cause))
        self._number += 1

    def marks(self, after_us: int, until_us: int, settings: InputSettings) -> Marks:
        """Return the marks up to `until_us`, (n,) MARK in stream time; those up to `after_us` have been told before."""
        while self._happen(after_us, until_us, settings):
            pass
        told, self._told = np.array(self._told, MARK), []
        return join_marks([told, self._generated(after_us, until_us, settings)])

    def _happen(self, after_us: int, until_us: int, settings: InputSettings) -> bool:
        """Do what happens next: a change of the signal, or its having been there for a pulse's length."""
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
        self._level, self._level_since_us, self._level_cause = level, at_us, None
        if settings.rising if level else settings.falling:
            self._tell(at_us, Special.INPUT_RISING if level else Special.INPUT_FALLING, cause, settings)
        if level == settings.active_high:
            self._level_cause = cause
        else:
            self._close(cause)

    def _pulse(self, at_us: int, settings: InputSettings) -> None:
        cause, self._level_cause = self._level_cause, None
        if settings.pulses and self._level == settings.active_high and cause is not None:
            self._tell(at_us, Special.INPUT_PULSE, cause, settings)
        self._close(cause)

    def _tell(self, at_us: int, code: Special, cause: _Cause, settings: InputSettings) -> None:
        if settings.told_from_us is None or at_us < settings.told_from_us:
            return
        self._told.append((at_us, int(code)))
        self.added += cause.marks > 0
        cause.marks += 1

    def _close(self, cause: _Cause | None) -> None:
        """Say that one of the things an edge could lead to is over."""
        if cause is not None:
            cause.open -= 1
            self.ignored += cause.open == 0 and cause.marks == 0

    def _generated(self, after_us: int, until_us: int, settings: InputSettings) -> Marks:
        generator, told_from_us = settings.generator, settings.told_from_us
        if generator is None or told_from_us is None:
            self._generator = None
            return no_marks()
        if self._generator is None or self._generator[0] != generator:
            self._generator = (generator, after_us)
        marks = generator.marks(self._generator[1], max(after_us, told_from_us - 1), until_us)
        self.added += len(marks)
        return marks


def _marks_at(times_us: npt.NDArray[np.int64], code: Special) -> Marks:
    marks = no_marks(len(times_us))
    marks["t"], marks["code"] = times_us, int(code)
    return marks
