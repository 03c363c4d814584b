"""Limits of a reception, and the event rate shown meanwhile; the same for all kinds of link."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from emulator.cli.output import BAD_VERDICT, GOOD, LACKING, Failure, status
from emulator.cli.output_paths import check_output
from transports.recording.record import Recorder

__all__ = ["Limits", "Progress", "told", "until"]

_LINE_PERIOD_S = 1.0


class Progress(Protocol):
    """State of a reception."""

    @property
    def events(self) -> int:
        """Events so far."""

    @property
    def seconds(self) -> float:
        """Wall time so far."""


@dataclass(frozen=True)
class Limits:
    """When to stop, and the file for the received events.

    Attributes
    ----------
    seconds
        Stop after this time, seconds.
    events
        Stop after this many events.
    record
        Write the received events to this .npz (fields `events` and `edges`, camera time).
    """

    seconds: float | None = None
    events: int | None = None
    record: Path | None = None

    def check(self) -> None:
        """Raise Failure when the record cannot be written."""
        check_output("--record", self.record, ".npz")

    @contextmanager
    def recorder(self) -> Iterator[Recorder | None]:
        """Give the recorder, and close it after the reception; raises Failure when it cannot be opened."""
        try:
            recorder = None if self.record is None else Recorder(self.record)
        except OSError as error:
            raise Failure(f"--record: {error.filename}: {error.strerror}", LACKING) from error
        try:
            yield recorder
        finally:
            if recorder is not None:
                recorder.close()


def told(problems: list[str], faults: int) -> int:
    """Tell the problems of a reception on stderr, a line each, and return the exit code."""
    for problem in problems:
        status.print(f"evstim: {problem}", markup=False)
    return BAD_VERDICT if problems or faults else GOOD


def until(limits: Limits) -> Callable[[Progress], bool]:
    """Return a function that is False past a limit and after Ctrl-C; it prints the event rate meanwhile."""
    stopped = False
    next_line_s, before = _LINE_PERIOD_S, (0, 0.0)

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)

    def goes_on(now: Progress) -> bool:
        nonlocal next_line_s, before
        if now.seconds >= next_line_s:
            rate = (now.events - before[0]) / (now.seconds - before[1]) * 1e-3
            status.print(f"{now.seconds:7.1f} s  {now.events:>12} events  {rate:9.3f} kev/s")
            next_line_s, before = now.seconds + _LINE_PERIOD_S, (now.events, now.seconds)
        in_time = limits.seconds is None or now.seconds < limits.seconds
        return not stopped and in_time and (limits.events is None or now.events < limits.events)

    return goes_on
