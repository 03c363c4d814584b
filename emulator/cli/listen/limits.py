"""What all listeners share: how long to listen, and the rate told meanwhile."""

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
    """What a listener knows of itself."""

    @property
    def events(self) -> int:
        """Events so far."""

    @property
    def seconds(self) -> float:
        """Wall time so far."""


@dataclass(frozen=True)
class Limits:
    """When to stop, and where to keep what came.

    Attributes
    ----------
    seconds
        Stop after this time.
    events
        Stop after this many events.
    record
        Write what arrives to this .npz (fields `events` and `edges`, the camera's time).
    """

    seconds: float | None = None
    events: int | None = None
    record: Path | None = None

    def check(self) -> None:
        """Raise Failure when the record has no folder."""
        if self.record is not None and not self.record.parent.is_dir():
            raise Failure(f"--record: the folder {self.record.parent} does not exist", WRONG_USE)


def until(limits: Limits) -> Callable[[Progress], bool]:
    """Return what says whether to go on: not past a limit, and not after Ctrl-C; tells the rate meanwhile."""
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
