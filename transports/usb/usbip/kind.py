"""Parameters of a USB/IP link, and its registration as a kind of link."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, ClassVar

from transports.faults.usb import USB_FAULTS
from transports.link.endpoint import EndpointFactory
from transports.link.kind import LinkKind, Listener, Wiring
from transports.needs import VHCI
from transports.network import check_allow
from transports.usb.loopback import check_model

__all__ = ["USBIP", "UsbipLink"]


@dataclass(frozen=True)
class UsbipLink:
    """The camera as a USB device over USB/IP: `usbip attach -r HOST -b BUSID` on a Linux machine.

    Attributes
    ----------
    host, port
        Address to listen on. USB/IP has no authentication: use 127.0.0.1 or a private network.
    allow
        Addresses and networks that may connect; required if other machines can reach `host`.
    busid
        Bus id under which the camera is exported.
    name
        Name of the link in this rig: in reports, faults and triggers.
    """

    kind: ClassVar[str] = "usbip"
    host: str = "127.0.0.1"
    port: int = 3240
    busid: str = "1-1"
    name: str = "usbip"
    allow: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ValueError(f"port must be 0 (any free one) to 65535, got {self.port}")
        if not re.fullmatch(r"[1-9]\d{0,2}-[1-9]\d{0,2}", self.busid):
            raise ValueError(f"busid must be a bus and a port such as '1-1', got {self.busid!r}")
        check_allow(self.host, self.allow)


def _endpoint(link: UsbipLink, wiring: Wiring) -> EndpointFactory[Any]:
    from transports.usb.usbip.server import UsbipFactory

    return UsbipFactory(link.host, link.port, link.busid, wiring.faults, link.allow)


USBIP = LinkKind(
    UsbipLink,
    serves="usb",
    endpoint=_endpoint,
    faults=USB_FAULTS,
    listener=Listener("usb", "Read a DAVIS346 or an EVK4 on USB.", "emulator.cli.listen.cameras:listen"),
    check=check_model,
    listens_on=lambda link: (link.host, link.port) if link.port else None,
    needs=lambda link: (VHCI,),
)
