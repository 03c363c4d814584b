"""Limits, progress and summary of a reception, for all kinds of link.

Listeners of an instrument, on a serial line or in datagrams, also have telecommand options.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Protocol

from cyclopts import Parameter

from emulator.cli.checks import check_output, prepared
from emulator.cli.output import BAD_VERDICT, GOOD, LACKING, Failure, console, status
from emulator.cli.run_summary import quantile_text
from emulator.run.kernels import DECODER
from firmware_protocol.packets.telecommands import (
    Ping,
    RequestHousekeeping,
    SetRateLimit,
    SetRegion,
    SetTick,
    SetTime,
    Start,
    Stop,
    Telecommand,
)
from transports.link.reception import Reception
from transports.recording.record import Recorder

__all__ = ["Limits", "Progress", "TelecommandOptions", "print_reception", "received", "report_problems", "until"]


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

    @contextmanager
    def recorder(self) -> Iterator[Recorder | None]:
        """Yield the recorder, and close it after the reception; raises Failure when it cannot be opened."""
        try:
            recorder = None if self.record is None else Recorder(self.record)
        except OSError as error:
            raise Failure(f"--record: {error.filename}: {error.strerror}", LACKING) from error
        try:
            yield recorder
        finally:
            if recorder is not None:
                recorder.close()


def report_problems(problems: list[str], faults: int) -> int:
    """Print the problems of a reception on stderr, a line each, and return the exit code."""
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


@dataclass(frozen=True)
class TelecommandOptions:
    """Telecommands sent once, when the link is open, in this order.

    Attributes
    ----------
    set_time
        Set the camera's clock to this machine's (UTC as Unix time).
    tick
        Resolution of event times: 1, 10, 100 or 1000 us.
    region
        X Y WIDTH HEIGHT: send only these pixels.
    rate_limit
        Send at most this many events per second; 0: no limit.
    start
        Start sending events.
    stop
        Stop sending events.
    ping
        Request a sign of life.
    housekeeping
        Request a housekeeping report now.
    """

    set_time: Annotated[bool, Parameter(negative="")] = False
    tick: int | None = None
    region: Annotated[tuple[int, int, int, int] | None, Parameter(negative="")] = None
    rate_limit: int | None = None
    start: Annotated[bool, Parameter(negative="")] = False
    stop: Annotated[bool, Parameter(negative="")] = False
    ping: Annotated[bool, Parameter(negative="")] = False
    housekeeping: Annotated[bool, Parameter(negative="")] = False

    def telecommands(self) -> list[Telecommand]:
        """Return the telecommands; raises ValueError for a value out of range."""
        wanted: list[tuple[bool, Callable[[], Telecommand]]] = [
            (self.set_time, lambda: SetTime(time.time_ns() // 1000)),
            (self.tick is not None, lambda: SetTick(self.tick or 0)),
            (self.region is not None, lambda: SetRegion(*(self.region or ()))),
            (self.rate_limit is not None, lambda: SetRateLimit(self.rate_limit or 0)),
            (self.start, Start),
            (self.stop, Stop),
            (self.ping, Ping),
            (self.housekeeping, RequestHousekeeping),
        ]
        return [make() for is_wanted, make in wanted if is_wanted]


def received(
    listen: Callable[[Callable[[Reception], bool], Recorder | None], Reception], limits: Limits
) -> tuple[Reception, str]:
    """Return the reception, and the reason if its record is not complete, else ""; print answers as they come."""
    prepared([DECODER])
    goes_on = until(limits)
    answers = 0

    def follow(now: Reception) -> bool:
        nonlocal answers
        for answer in now.answer_texts[len(now.answer_texts) - (now.answers - answers) :]:
            status.print(answer, markup=False)
        answers = now.answers
        return goes_on(now)

    try:
        with limits.recorder() as recorder:
            reception = listen(follow, recorder)
    except OSError as error:
        raise Failure(str(error), LACKING) from error
    return reception, recorder.trouble if recorder is not None else ""


def print_reception(reception: Reception) -> None:
    """Print a reception, for people."""
    console.print(
        f"{reception.events} events and {reception.edges} edges in {reception.seconds:.2f} s, "
        f"digest {reception.digest:08x}{', the other side closed the line' if reception.gone else ''}"
    )
    console.print(", ".join(f"{count} {name}" for name, count in reception.counts.items()), markup=False)
    jitter = reception.jitter_us
    if jitter.p50 is not None:
        p50, p99 = quantile_text(jitter.p50), quantile_text(jitter.p99)
        console.print(f"delay of blocks above the shortest: p50 {p50} us, p99 {p99} us")
    if (report := reception.housekeeping) is not None:
        e = report.events
        console.print(
            f"housekeeping: {report.mode.name.lower()}, {e.offered} events offered = {e.sent} sent + {e.waiting} "
            f"waiting + {e.not_running} not running + {e.not_selected} not selected + {e.over_rate} over the rate + "
            f"{e.too_late} too late + {e.buffer_full} buffer full + {e.flushed} flushed + {e.lost_on_link} lost"
        )
    console.print("no fault" if not reception.faults else f"{reception.faults} FAULTS")
