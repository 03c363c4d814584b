"""The record of serial lines."""

from __future__ import annotations

from typing import Any

from transports.faults.kinds import SERIAL_FAULTS
from transports.link.endpoint import EndpointFactory
from transports.link.kind import LinkKind, Listener, Wiring, check_region
from transports.serial_line.parameters import SerialParameters

__all__ = ["SERIAL"]


def _endpoint(line: SerialParameters, wiring: Wiring) -> EndpointFactory[Any]:
    from transports.serial_line.endpoint import SerialFactory

    return SerialFactory(line, wiring.faults)


SERIAL = LinkKind(
    SerialParameters,
    serves="instrument",
    endpoint=_endpoint,
    faults=SERIAL_FAULTS,
    listener=Listener("serial", "Read a camera on a serial line.", "emulator.cli.listen.serial:serial"),
    check=check_region,
)
