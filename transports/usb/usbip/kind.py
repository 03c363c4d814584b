"""The record of USB/IP links."""

from __future__ import annotations

from typing import Any

from transports.faults.usb_kinds import USB_FAULTS
from transports.link.endpoint import EndpointFactory
from transports.link.kind import LinkKind, Listener, Wiring
from transports.needs import VHCI
from transports.usb.models import check_model
from transports.usb.usbip.parameters import UsbipLink

__all__ = ["USBIP"]


def _endpoint(link: UsbipLink, wiring: Wiring) -> EndpointFactory[Any]:
    from transports.usb.usbip.endpoint import UsbipFactory

    return UsbipFactory(link.host, link.port, link.busid, wiring.faults, link.allow)


USBIP = LinkKind(
    UsbipLink,
    serves="usb",
    endpoint=_endpoint,
    faults=USB_FAULTS,
    listener=Listener("usb", "Read a DAVIS346 or an EVK4 on USB.", "emulator.cli.listen.usb:listen"),
    check=check_model,
    listens_on=lambda link: (link.host, link.port) if link.port else None,
    needs=lambda link: (VHCI,),
)
