"""The record of links on a USB cable."""

from __future__ import annotations

from typing import Any

from transports.faults.usb_kinds import USB_FAULTS
from transports.link.endpoint import EndpointFactory
from transports.link.kind import LinkKind, Wiring
from transports.needs import UDC
from transports.usb.functionfs.parameters import UsbGadgetLink
from transports.usb.models import check_model

__all__ = ["USB_GADGET"]


def _endpoint(link: UsbGadgetLink, wiring: Wiring) -> EndpointFactory[Any]:
    from transports.usb.functionfs.endpoint import GadgetFactory

    return GadgetFactory(link.gadget, link.udc, wiring.faults)


USB_GADGET = LinkKind(
    UsbGadgetLink,
    serves="usb",
    endpoint=_endpoint,
    faults=USB_FAULTS,
    check=check_model,
    needs=lambda link: (UDC,),
)
