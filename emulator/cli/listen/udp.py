"""`evstim listen udp`: the receiving side of packets in UDP datagrams."""

from __future__ import annotations

import dataclasses
from typing import Annotated

from cyclopts import Parameter

from emulator.cli.listen.limits import Limits, told
from emulator.cli.listen.orders import Orders, print_reception, received
from emulator.cli.output import WRONG_USE, Failure, print_json
from transports.link.pacing import MonotonicClock
from transports.network.allow import check_allow
from transports.udp_packets.listener import Ports, listen_udp

__all__ = ["udp"]

_NO_LIMITS, _NO_ORDERS = Limits(), Orders()


def udp(
    at: str = "127.0.0.1:10015",
    /,
    *,
    camera: str = "127.0.0.1:10025",
    allow: Annotated[tuple[str, ...], Parameter(negative="")] = (),
    orders: Annotated[Orders, Parameter(name="*")] = _NO_ORDERS,
    limits: Annotated[Limits, Parameter(name="*")] = _NO_LIMITS,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Read a camera whose packets come in UDP datagrams, and count what is missing. Ctrl-C ends it.

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
        When to stop, and the file for the received events.
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
    return told(problems, reception.faults)


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 1 <= int(port) <= 65535:
        raise Failure(f"{text!r} is not HOST:PORT, such as 127.0.0.1:10015", WRONG_USE)
    return host.strip("[]"), int(port)
