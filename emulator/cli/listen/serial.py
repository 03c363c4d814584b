"""`evstim listen serial`: the receiving side of a serial line."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

from cyclopts import Parameter

from emulator.cli.listen.limits import Limits, told, until
from emulator.cli.output import LACKING, WRONG_USE, Failure, console, print_json, status
from emulator.cli.preparing import prepared
from emulator.cli.run_output.latency import quantile_text
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
from transports.link.pacing import MonotonicClock
from transports.serial_line.listener import SerialReception, listen_serial
from transports.serial_line.parameters import SerialParameters

__all__ = ["serial"]


@dataclass(frozen=True)
class Line:
    """Settings of the line; the same on both sides.

    Attributes
    ----------
    profile
        Packets and framing.
    baud
        Bit rate, bit/s; a pty ignores it.
    parity
        Parity bit of each character.
    stop_bits
        Stop bits of each character: 1, 1.5 or 2.
    """

    profile: Literal["ccsds-cobs", "ccsds-slip", "ccsds-kiss", "csp-kiss", "fprime"] = "ccsds-cobs"
    baud: int = 921_600
    parity: Literal["none", "even", "odd", "mark", "space"] = "none"
    stop_bits: float = 1.0


@dataclass(frozen=True)
class Orders:
    """Telecommands sent once, when the line is open, in this order.

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
        Ask for a sign of life.
    housekeeping
        Ask for a housekeeping report now.
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


_GONE = "the line went away before the reception was to end: it was unplugged, or the camera's run ended or died"
_NO_LIMITS, _LINE, _NO_ORDERS = Limits(), Line(), Orders()


def serial(
    port: str,
    /,
    *,
    line: Annotated[Line, Parameter(name="*")] = _LINE,
    orders: Annotated[Orders, Parameter(name="*")] = _NO_ORDERS,
    limits: Annotated[Limits, Parameter(name="*")] = _NO_LIMITS,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Read a camera on a serial line, decode its telemetry, and count what is missing. Ctrl-C ends it.

    Parameters
    ----------
    port
        Path of the port, such as the one that `evstim run serial-demo` prints, or any URL of pyserial.
    line
        Settings of the line.
    orders
        Telecommands to send.
    limits
        When to stop, and the file for the received events.
    json
        Print one JSON object as the last line on stdout.
    """
    limits.check()
    try:
        parameters = SerialParameters(port=port, **dataclasses.asdict(line))
        telecommands = orders.telecommands()
    except ValueError as error:
        raise Failure(str(error), WRONG_USE) from error
    if port == "pty":
        raise Failure("give the path that `evstim run` prints: a receiver does not make a pty", WRONG_USE)
    reception, trouble = _listen(parameters, telecommands, limits)
    problems = [_GONE] * reception.gone + [trouble] * bool(trouble)
    if json:
        print_json({**dataclasses.asdict(reception), "problems": problems})
    else:
        _print(reception)
    return told(problems, reception.faults)


def _listen(
    parameters: SerialParameters, telecommands: list[Telecommand], limits: Limits
) -> tuple[SerialReception, str]:
    """Return what came, and why its record is not whole; empty where it is."""
    prepared([DECODER])
    goes_on = until(limits)
    answers = 0

    def follow(now: SerialReception) -> bool:
        nonlocal answers
        for answer in now.told[len(now.told) - (now.answers - answers) :]:
            status.print(answer, markup=False)
        answers = now.answers
        return goes_on(now)

    try:
        with limits.recorder() as recorder:
            reception = listen_serial(parameters, follow, MonotonicClock(), recorder, telecommands)
    except OSError as error:
        raise Failure(str(error), LACKING) from error
    return reception, recorder.trouble if recorder is not None else ""


def _print(reception: SerialReception) -> None:
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
