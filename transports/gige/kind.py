"""The record of GigE Vision links."""

from __future__ import annotations

from typing import Any

from transports.gige.packet_faults import PACKET_FAULTS
from transports.gige.parameters import GigeLink
from transports.link.endpoint import EndpointFactory
from transports.link.kind import CameraFacts, LinkKind, Listener, Unsuitable, Wiring

__all__ = ["GIGE"]


def _endpoint(link: GigeLink, wiring: Wiring) -> EndpointFactory[Any]:
    from transports.gige.endpoint import GigeFactory

    return GigeFactory(link, wiring.faults)


def _check(link: GigeLink, camera: CameraFacts) -> None:
    """Raise Unsuitable for a camera without a GigE Vision device."""
    if camera.model not in camera.gige_models:
        models = " or ".join(f'model = "{name}"' for name in camera.gige_models)
        raise Unsuitable(f"a {camera.model} has no Ethernet plug; use {models}", "kind")


GIGE = LinkKind(
    GigeLink,
    serves="gige",
    endpoint=_endpoint,
    faults=PACKET_FAULTS,
    listener=Listener("gige", "Read a GigE Vision event camera.", "emulator.cli.listen.gige:gige"),
    check=_check,
    has_evt=lambda link: True,
    listens_on=lambda link: (link.host, link.port) if link.port else None,
)
