"""`evstim listen serial` and `evstim listen udp`: the receiving side of packets on a serial line and in UDP."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

from cyclopts import Parameter

from emulator.cli.checks import prepared
from emulator.cli.listen import NO_LIMITS, Limits, Source, listen_to
from emulator.cli.output import LACKING, WRONG_USE, Failure, Flag, Json, failing, parsed_address, status
from emulator.cli.run_summary import latency_text
from emulator.run.kernels import DECODER
from firmware_protocol.packets import telecommands as requests
from transports.link.pacing import MonotonicClock
from transports.network import check_allow
from transports.reception import InstrumentReception
from transports.recording.record import Recorder
from transports.serial_line.kind import SerialLink
from transports.serial_line.port import listen_serial
from transports.udp_packets.endpoint import Ports, listen_udp


@Parameter(name="*")
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


@Parameter(name="*")
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

    set_time: Flag = False
    tick: int | None = None
    region: Annotated[tuple[int, int, int, int] | None, Parameter(negative="")] = None
    rate_limit: int | None = None
    start: Flag = False
    stop: Flag = False
    ping: Flag = False
    housekeeping: Flag = False

    def telecommands(self) -> list[requests.Telecommand]:
        """Return the telecommands; raises ValueError for a value out of range."""
        choices: list[tuple[bool, Callable[[], requests.Telecommand]]] = [
            (self.set_time, lambda: requests.SetTime(time.time_ns() // 1000)),
            (self.tick is not None, lambda: requests.SetTick(self.tick or 0)),
            (self.region is not None, lambda: requests.SetRegion(*(self.region or ()))),
            (self.rate_limit is not None, lambda: requests.SetRateLimit(self.rate_limit or 0)),
            (self.start, requests.Start),
            (self.stop, requests.Stop),
            (self.ping, requests.Ping),
            (self.housekeeping, requests.RequestHousekeeping),
        ]
        return [make() for is_wanted, make in choices if is_wanted]


_GONE = "the line went away before the reception was to end: it was unplugged, or the camera's run ended or died"
_GoesOn = Callable[[InstrumentReception], bool]


def serial(
    port: str,
    /,
    *,
    line: Line = Line(),
    orders: TelecommandOptions = TelecommandOptions(),
    limits: Limits = NO_LIMITS,
    json: Json = False,
) -> int:
    """Read a camera on a serial line, decode its telemetry, and count the losses. Ctrl-C ends it.

    Parameters
    ----------
    port
        Path of the port, such as the one that `evstim run serial-demo` prints, or any URL of pyserial.
    """
    limits.check()
    with failing(WRONG_USE, ValueError):
        parameters = SerialLink(port=port, **dataclasses.asdict(line))
        telecommands = orders.telecommands()
    if port == "pty":
        raise Failure("give the path that `evstim run` prints: a receiver does not make a pty", WRONG_USE)

    def receive(goes_on: _GoesOn, recorder: Recorder | None) -> InstrumentReception:
        with failing(LACKING, OSError):
            return listen_serial(parameters, _with_answers(goes_on), MonotonicClock(), recorder, telecommands)

    prepared([DECODER])
    return listen_to(Source(receive, _summary, _GONE), limits, json=json)


def udp(
    at: str = "127.0.0.1:10015",
    /,
    *,
    camera: str = "127.0.0.1:10025",
    allow: Annotated[tuple[str, ...], Parameter(negative="")] = (),
    orders: TelecommandOptions = TelecommandOptions(),
    limits: Limits = NO_LIMITS,
    json: Json = False,
) -> int:
    """Read a camera whose packets come in UDP datagrams, and count the losses. Ctrl-C ends it.

    Parameters
    ----------
    at
        HOST:PORT on which packets come in, as the rig's link has it.
    camera
        HOST:PORT on which the camera takes telecommands.
    allow
        Addresses and networks whose packets are taken; needed where HOST can be reached from other machines.
    """
    limits.check()
    host, port = parsed_address("AT", at)
    ports = Ports(host, port, *parsed_address("--camera", camera), allow)
    with failing(WRONG_USE, ValueError):
        check_allow(host, allow, "HOST")
        telecommands = orders.telecommands()

    def receive(goes_on: _GoesOn, recorder: Recorder | None) -> InstrumentReception:
        with failing(LACKING, OSError):
            return listen_udp(ports, _with_answers(goes_on), MonotonicClock(), recorder, telecommands)

    prepared([DECODER])
    return listen_to(Source(receive, _summary), limits, json=json)


def _with_answers(goes_on: _GoesOn) -> _GoesOn:
    """Return `goes_on`, which now also prints the answers to telecommands as they come."""
    answers = 0

    def follow(now: InstrumentReception) -> bool:
        nonlocal answers
        for answer in now.answer_texts[len(now.answer_texts) - (now.answers - answers) :]:
            status.print(answer, markup=False)
        answers = now.answers
        return goes_on(now)

    return follow


def _summary(reception: InstrumentReception) -> list[str]:
    lines = [", the other side closed the line" if reception.gone else ""]
    lines.append(", ".join(f"{count} {name}" for name, count in reception.counts.items()))
    if reception.jitter_us.p50 is not None:
        lines.append(f"delay of blocks above the shortest: {latency_text(reception.jitter_us)}")
    if (report := reception.housekeeping) is not None:
        e = report.events
        lines.append(
            f"housekeeping: {report.mode.name.lower()}, {e.offered} events offered = {e.sent} sent + {e.waiting} "
            f"waiting + {e.not_running} not running + {e.not_selected} not selected + {e.over_rate} over the rate + "
            f"{e.too_late} too late + {e.buffer_full} buffer full + {e.flushed} flushed + {e.lost_on_link} lost"
        )
    return [*lines, "no fault" if not reception.faults else f"{reception.faults} FAULTS"]
