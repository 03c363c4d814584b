"""Limits of a reception, and the event rate shown meanwhile; the same for all kinds of link."""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from emulator.cli.output import WRONG_USE, Failure, status

__all__ = ["Limits", "Progress", "until"]

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
        """Raise Failure when the record has no folder."""
        if self.record is not None and not self.record.parent.is_dir():
            raise Failure(f"--record: the folder {self.record.parent} does not exist", WRONG_USE)


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
