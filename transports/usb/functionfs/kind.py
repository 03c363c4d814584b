"""Parameters of a link on a USB cable, and its registration as a kind of link."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from transports.faults.usb import USB_FAULTS
from transports.link.endpoint import EndpointFactory
from transports.link.kind import LinkKind, Wiring
from transports.needs import UDC
from transports.usb.functionfs.gadget import check_name
from transports.usb.loopback import check_model

__all__ = ["USB_GADGET", "UsbGadgetLink"]


@dataclass(frozen=True)
class UsbGadgetLink:
    """The camera on a real USB cable, on a machine with a USB device port, such as a Raspberry Pi (docs/cable.md).

    Attributes
    ----------
    udc
        The USB device controller, as named in /sys/class/udc; may be omitted if there is only one.
    gadget
        Name of the gadget. It is made at the start of the run and removed at its end, unless `evstim gadget up` made
        it.
    name
        Name of the link in this rig: in reports, faults and triggers.
    """

    kind: ClassVar[str] = "usb_gadget"
    udc: str = ""
    gadget: str = "evstim"
    name: str = "usb_gadget"

    def __post_init__(self) -> None:
        check_name(self.gadget)


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
