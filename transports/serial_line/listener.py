"""A computer on a serial line: reads an instrument until told to stop or the line is gone; may tell it something."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from firmware_protocol.packets.telecommands import Telecommand
from transports.link.pacing import Clock
from transports.link.reception import Receiving, Reception
from transports.recording.record import Recorder
from transports.serial_line.opening import open_port
from transports.serial_line.parameters import SerialParameters
from transports.serial_line.port import Port

__all__ = ["listen_serial"]

_LOOK_PERIOD_NS = 500_000


def listen_serial(
    line: SerialParameters,
    goes_on: Callable[[Reception], bool],
    clock: Clock,
    recorder: Recorder | None = None,
    commands: Sequence[Telecommand] = (),
) -> Reception:
    """Open the port, tell `commands`, and read while `goes_on` says so, which is asked after each look.

    Raises OSError when the port cannot be had; one that goes away later ends the visit.
    """
    listening = Receiving(line.profile, clock, recorder)
    port = open_port(line)
    unsent = b"".join(listening.receiver.wrap(command) for command in commands)
    gone = False
    try:
        while goes_on(listening.now):
            unsent = unsent[port.write(unsent) :] if unsent else b""
            listening.take(_all_there(port))
            clock.sleep_until(clock.now_ns() + _LOOK_PERIOD_NS)
    except OSError:
        gone = True
    finally:
        port.close()
    return listening.finish(gone=gone)


def _all_there(port: Port) -> bytes:
    parts = []
    while data := port.read():
        parts.append(data)
    return b"".join(parts)
