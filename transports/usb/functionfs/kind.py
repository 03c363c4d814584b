"""The record of links on a USB cable.

What a rig says of a USB gadget.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from transports.faults.usb_kinds import USB_FAULTS
from transports.link.endpoint import EndpointFactory
from transports.link.kind import LinkKind, Wiring
from transports.needs import UDC
from transports.usb.functionfs.gadget import check_name
from transports.usb.loopback import check_model

__all__ = ["USB_GADGET", "UsbGadgetLink"]


@dataclass(frozen=True)
class UsbGadgetLink:
    """The camera on a real USB cable: this machine has a USB device port, as a Raspberry Pi has (docs/cable.md).

    Attributes
    ----------
    udc
        The USB device controller, as /sys/class/udc names it; may be left out where there is one.
    gadget
        Name of the gadget. It is made when the run begins and removed when it ends, unless `evstim gadget up` made it.
    name
        What this rig calls the link: in reports, and where faults and triggers name it.
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
