"""The record of CAN links."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from firmware_protocol.can_frames.identifiers import Identifiers
from firmware_protocol.can_frames.raw_events import RAW_LIMIT_PX
from transports.can_bus.parameters import CanParameters
from transports.faults.can_kinds import CAN_FAULTS, ErrorFrames
from transports.faults.kinds import Fault
from transports.link.endpoint import EndpointFactory
from transports.link.kind import CameraFacts, LinkKind, Listener, Unsuitable, Wiring, check_region
from transports.needs import Need, network_interface

__all__ = ["CAN"]

_OWN_BUSES = ("served", "virtual")
"""Interfaces that carry an error frame that is given to them; a controller makes its own."""


def _endpoint(parameters: CanParameters, wiring: Wiring) -> EndpointFactory[Any]:
    from transports.can_bus.endpoint import CanFactory

    return CanFactory(parameters, wiring.sink, wiring.faults)


def _faults_of(parameters: CanParameters) -> Mapping[str, type[Fault]]:
    own = parameters.interface in _OWN_BUSES
    return {kind: fault for kind, fault in CAN_FAULTS.items() if own or fault is not ErrorFrames}


def _with_identifiers(table: dict[str, Any]) -> dict[str, Any]:
    """Let the identifiers follow the node number where the rig does not give them."""
    node, own = table.get("node", CanParameters.node), table.get("identifiers", {})
    if not isinstance(node, int) or not 1 <= node <= 127 or not isinstance(own, dict):
        return table  # refused where its type is checked
    return {**table, "identifiers": {**Identifiers.of_node(node).by_name, **own}}


def _check(parameters: CanParameters, camera: CameraFacts) -> None:
    """Raise Unsuitable for a region beyond the sensor, or a sensor beyond what raw frames can number."""
    check_region(parameters, camera)
    if parameters.carriage == "raw" and max(camera.size) > RAW_LIMIT_PX:
        raise Unsuitable(
            f"raw frames number {RAW_LIMIT_PX} columns and rows, not {camera.size[0]}x{camera.size[1]}; "
            'use carriage = "isotp" or "cfp"',
            "carriage",
        )


def _listens_on(parameters: CanParameters) -> tuple[str, int] | None:
    served = parameters.interface == "served" and parameters.port
    return (parameters.host, parameters.port) if served else None


def _needs(parameters: CanParameters) -> tuple[Need, ...]:
    if parameters.interface != "socketcan":
        return ()
    return tuple(network_interface(name) for name in (parameters.channel, parameters.channel_b) if name)


CAN = LinkKind(
    CanParameters,
    serves="instrument",
    endpoint=_endpoint,
    has_sync=True,
    faults=CAN_FAULTS,
    faults_of=_faults_of,
    listener=Listener("can", "Read a camera on a CAN bus.", "emulator.cli.listen.can:can"),
    complete=_with_identifiers,
    check=_check,
    listens_on=_listens_on,
    needs=_needs,
)
