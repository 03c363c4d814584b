"""Links of a USB camera: parameters of each, and its registration as a kind of link."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import ClassVar

from firmware_protocol.bounds import check_bounds
from transports.faults.kinds import USB_LINK
from transports.link.kind import CameraFacts, LinkKind, LinkParameters, Listener, Port, Unsuitable
from transports.needs import UDC, VHCI, Need
from transports.network import check_allow


def _check_model(link: LinkParameters, camera: CameraFacts) -> None:
    """Raise Unsuitable for a camera without a USB device."""
    if camera.usb_size == camera.size:
        return
    models: dict[tuple[int, int], list[str]] = {}
    for name, size in camera.usb_models().items():
        models.setdefault(size, []).append(f'"{name}"')
    cures = " or ".join(
        f"model = {', '.join(names)} with {size[0]}x{size[1]} pixels" for size, names in sorted(models.items())
    )
    raise Unsuitable(
        f"there is no USB model for a {camera.model} of {camera.size[0]}x{camera.size[1]} pixels yet; use "
        f'kind = "loopback", or {cures}',
        "kind",
    )


@dataclass(frozen=True)
class UsbipLink(LinkParameters):
    """The camera as a USB device over USB/IP: `usbip attach -r HOST -b BUSID` on a Linux machine.

    Attributes
    ----------
    host, port : address to listen on. USB/IP has no authentication: use 127.0.0.1 or a private network.
    allow : addresses and networks that may connect; required if other machines can reach `host`.
    busid : bus id under which the camera is exported.
    name : name of the link, for reports, faults and triggers.
    """

    kind: ClassVar[str] = "usbip"
    host: str = "127.0.0.1"
    port: Port = 3240
    busid: str = "1-1"
    name: str = "usbip"
    allow: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_bounds(self)
        if not re.fullmatch(r"[1-9]\d{0,2}-[1-9]\d{0,2}", self.busid):
            raise ValueError(f"busid must be a bus and a port such as '1-1', got {self.busid!r}")
        check_allow(self.host, self.allow)

    def listens_on(self) -> tuple[str, int] | None:
        """Return the address, unless any free port is suitable."""
        return (self.host, self.port) if self.port else None

    def needs(self) -> tuple[Need, ...]:
        """Return the kernel module that attaches it."""
        return (VHCI,)


USBIP = LinkKind(
    UsbipLink,
    serves="usb",
    endpoint="transports.usb.usbip.endpoint:UsbipFactory",
    carrier=USB_LINK,
    listener=Listener("usb", "Read an event camera on USB.", "emulator.cli.listen.cameras:listen"),
    check=_check_model,
)


def check_name(name: str) -> None:
    """Raise ValueError for a name that is not valid for a gadget, a function and a folder."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,30}", name):
        raise ValueError(f"a gadget's name has 1 to 31 letters, digits, '-' and '_', got {name!r}")


_CABLE_HZ = {"high": 35e6 / 5, "super": 400e6 / 5}  # at some five octets an event


@dataclass(frozen=True)
class UsbGadgetLink(LinkParameters):
    """The camera on a real USB cable, on a machine with a USB device port, such as a Raspberry Pi (docs/hosts.md).

    Attributes
    ----------
    udc : the USB device controller, as named in /sys/class/udc; may be omitted if there is only one.
    gadget : name of the gadget, made for the run unless `evstim gadget up` made it.
    name : name of the link, for reports, faults and triggers.
    """

    kind: ClassVar[str] = "usb_gadget"
    udc: str = ""
    gadget: str = "evstim"
    name: str = "usb_gadget"

    def __post_init__(self) -> None:
        check_name(self.gadget)

    def carries_hz(self, camera: CameraFacts) -> float:
        """Return the events a second that a cable carries at the camera's speed; a slower cable carries fewer."""
        return _CABLE_HZ[camera.speed]

    def needs(self) -> tuple[Need, ...]:
        """Return the USB device port."""
        return (UDC,)


USB_GADGET = LinkKind(
    UsbGadgetLink,
    serves="usb",
    endpoint="transports.usb.functionfs.endpoint:GadgetEndpoint",
    carrier=USB_LINK,
    check=_check_model,
)


@dataclass(frozen=True)
class LoopbackLink(LinkParameters):
    """A host inside the link's own process that starts the camera, decodes every byte and compares; without USB.

    Attributes
    ----------
    name : name of the link, for reports, faults and triggers.
    """

    kind: ClassVar[str] = "loopback"
    name: str = "loopback"


# A DAVIS346 can have any size. This host loses no data at the start, so the camera need not wait.
LOOPBACK = LinkKind(
    LoopbackLink, serves="usb", endpoint="transports.usb.loopback:LoopbackEndpoint", usb_model="davis346"
)
