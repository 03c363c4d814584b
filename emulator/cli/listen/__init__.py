"""Commands below `evstim listen`, one for each kind of link; here what is the same for all of them.

A command opens its camera and gives `listen_to` a `Source`; limits, progress, summary and exit code follow here.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any, Generic, TypeVar

from cyclopts import Parameter

from emulator.cli.checks import check_output
from emulator.cli.output import BAD_VERDICT, GOOD, LACKING, failing, print_result, status
from emulator.cli.signals import stop_on_signals
from transports.reception import Reception
from transports.recording.record import Recorder

_R = TypeVar("_R", bound=Reception)
_LINE_PERIOD_S = 1.0


@Parameter(name="*")
@dataclass(frozen=True)
class Limits:
    """Limits of a reception, and the file for the received events.

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

    def recorder(self) -> AbstractContextManager[Recorder | None]:
        """Return the recorder, to be closed after the reception; raises Failure when it cannot be opened."""
        with failing(LACKING, OSError, at=f"--record: {self.record}"):
            return nullcontext() if self.record is None else closing(Recorder(self.record))


NO_LIMITS = Limits()


@dataclass(frozen=True)
class Source(Generic[_R]):
    """Other side of a link.

    Attributes
    ----------
    receive
        Function that receives while its first argument returns True, and records by its second one.
    summary
        Function that returns the end of the summary's first line, and its further lines.
    gone
        Problem that is reported when the other side was lost too early.
    """

    receive: Callable[[Callable[[_R], bool], Recorder | None], _R]
    summary: Callable[[_R], list[str]]
    gone: str = ""


def listen_to(source: Source[Any], limits: Limits, *, json: bool) -> int:
    """Receive until a limit, Ctrl-C or the end of the other side; print the summary and return the exit code."""
    goes_on = _until(limits)
    with limits.recorder() as recorder:
        reception = source.receive(goes_on, recorder)
    problems = [source.gone] * reception.is_early
    if recorder is not None and recorder.trouble:
        problems.append(recorder.trouble)
    end, *lines = source.summary(reception)
    counts = f"{reception.events} events and {reception.edges} edges in {reception.seconds:.2f} s"
    lines = [f"{counts}, digest {reception.digest:08x}{end}", *lines]
    print_result(json, {**dataclasses.asdict(reception), "problems": problems}, lines)
    for problem in problems:
        status.print(f"evstim: {problem}", markup=False)
    return BAD_VERDICT if problems or reception.faults else GOOD


def _until(limits: Limits) -> Callable[[Reception], bool]:
    """Return a function that is False past a limit and after Ctrl-C; it prints the event rate meanwhile."""
    stopped = Event()
    stop_on_signals(stopped.set)
    next_line_s, before = _LINE_PERIOD_S, (0, 0.0)

    def goes_on(now: Reception) -> bool:
        nonlocal next_line_s, before
        if now.seconds >= next_line_s:
            rate = (now.events - before[0]) / (now.seconds - before[1]) * 1e-3
            status.print(f"{now.seconds:7.1f} s  {now.events:>12} events  {rate:9.3f} kev/s")
            next_line_s, before = now.seconds + _LINE_PERIOD_S, (now.events, now.seconds)
        in_time = limits.seconds is None or now.seconds < limits.seconds
        return not stopped.is_set() and in_time and (limits.events is None or now.events < limits.events)

    return goes_on
