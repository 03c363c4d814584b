"""`evstim listen serial`: the receiving side of a serial line.

`evstim listen udp`: the receiving side of packets in UDP datagrams.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Literal

from cyclopts import Parameter

from emulator.cli.listen.reception import Limits, TelecommandOptions, print_reception, received, report_problems
from emulator.cli.output import WRONG_USE, Failure, print_json
from transports.link.pacing import MonotonicClock
from transports.network.datagrams import check_allow
from transports.serial_line.kind import SerialLink
from transports.serial_line.port import listen_serial
from transports.udp_packets.endpoint import Ports, listen_udp

__all__ = ["serial", "udp"]


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


_GONE = "the line went away before the reception was to end: it was unplugged, or the camera's run ended or died"
_NO_LIMITS, _LINE, _NO_TELECOMMANDS = Limits(), Line(), TelecommandOptions()


def serial(
    port: str,
    /,
    *,
    line: Annotated[Line, Parameter(name="*")] = _LINE,
    orders: Annotated[TelecommandOptions, Parameter(name="*")] = _NO_TELECOMMANDS,
    limits: Annotated[Limits, Parameter(name="*")] = _NO_LIMITS,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Read a camera on a serial line, decode its telemetry, and count the losses. Ctrl-C ends it.

    Parameters
    ----------
    port
        Path of the port, such as the one that `evstim run serial-demo` prints, or any URL of pyserial.
    line
        Settings of the line.
    orders
        Telecommands to send.
    limits
        Limits of the reception, and the file for the received events.
    json
        Print one JSON object as the last line on stdout.
    """
    limits.check()
    try:
        parameters = SerialLink(port=port, **dataclasses.asdict(line))
        telecommands = orders.telecommands()
    except ValueError as error:
        raise Failure(str(error), WRONG_USE) from error
    if port == "pty":
        raise Failure("give the path that `evstim run` prints: a receiver does not make a pty", WRONG_USE)
    reception, trouble = received(
        lambda goes_on, recorder: listen_serial(parameters, goes_on, MonotonicClock(), recorder, telecommands), limits
    )
    problems = [_GONE] * reception.gone + [trouble] * bool(trouble)
    if json:
        print_json({**dataclasses.asdict(reception), "problems": problems})
    else:
        print_reception(reception)
    return report_problems(problems, reception.faults)


def udp(
    at: str = "127.0.0.1:10015",
    /,
    *,
    camera: str = "127.0.0.1:10025",
    allow: Annotated[tuple[str, ...], Parameter(negative="")] = (),
    orders: Annotated[TelecommandOptions, Parameter(name="*")] = _NO_TELECOMMANDS,
    limits: Annotated[Limits, Parameter(name="*")] = _NO_LIMITS,
    json: Annotated[bool, Parameter(negative="")] = False,
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
    orders
        Telecommands to send.
    limits
        Limits of the reception, and the file for the received events.
    json
        Print one JSON object as the last line on stdout.
    """
    limits.check()
    host, port = _address(at)
    ports = Ports(host, port, *_address(camera), allow)
    try:
        check_allow(host, allow, "HOST")
        telecommands = orders.telecommands()
    except ValueError as error:
        raise Failure(str(error), WRONG_USE) from error
    reception, trouble = received(
        lambda goes_on, recorder: listen_udp(ports, goes_on, MonotonicClock(), recorder, telecommands), limits
    )
    problems = [trouble] * bool(trouble)
    if json:
        print_json({**dataclasses.asdict(reception), "problems": problems})
    else:
        print_reception(reception)
    return report_problems(problems, reception.faults)


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 1 <= int(port) <= 65535:
        raise Failure(f"{text!r} is not HOST:PORT, such as 127.0.0.1:10015", WRONG_USE)
    return host.strip("[]"), int(port)
