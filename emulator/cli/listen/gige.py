"""`evstim listen gige`: the receiving side of a GigE Vision event camera."""

from __future__ import annotations

from contextlib import closing
from typing import Annotated

from cyclopts import Parameter

from emulator.cli.listen.reception import Limits, Source, lacking, listen_to
from emulator.cli.output import WRONG_USE, Failure, status
from firmware_protocol.gige.gvsp import LEAST_PACKET, MOST_PACKET
from transports.gige.host import GigeHost, GigeHostError, GigeReception, receive
from transports.link.pacing import MonotonicClock

__all__ = ["gige"]

_NO_LIMITS = Limits()
_GONE = "the camera went away before the reception was to end: its run ended or died, or another host took control"


def gige(
    at: str = "127.0.0.1:3956",
    /,
    *,
    packet_size: int = 1400,
    limits: Annotated[Limits, Parameter(name="*")] = _NO_LIMITS,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Read a GigE Vision event camera, and count the losses. Ctrl-C ends it.

    Parameters
    ----------
    at
        ADDRESS or ADDRESS:PORT of the camera.
    packet_size
        Octets of a packet with the headers of IP and UDP: 576 to 9000, even; no more than the network's MTU.
    limits
        Limits of the reception, and the file for the received events.
    json
        Print one JSON object as the last line on stdout.
    """
    limits.check()
    if not LEAST_PACKET <= packet_size <= MOST_PACKET or packet_size % 2:
        raise Failure(f"--packet-size must be even, {LEAST_PACKET} to {MOST_PACKET}, got {packet_size}", WRONG_USE)
    host, port = _address(at)
    clock = MonotonicClock()
    with lacking(GigeHostError), closing(GigeHost(host, port, now_ns=clock.now_ns)) as camera:
        about = camera.identity
        status.print(f"{about.manufacturer} {about.model} serial {about.serial}")
        source = Source(lambda goes_on, to: receive(camera, packet_size, goes_on, clock, to), _summary, _GONE)
        return listen_to(source, limits, json=json)


def _summary(reception: GigeReception) -> list[str]:
    return [f", {reception.blocks_lost} blocks lost, {reception.packets_requested} packets requested again"]


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.partition(":")
    if not host or (port and (not port.isdecimal() or not 1 <= int(port) <= 65535)):
        raise Failure(f"{text!r} is not ADDRESS or ADDRESS:PORT, such as 127.0.0.1:3956", WRONG_USE)
    return host, int(port or 3956)
