"""The record of USB/IP links."""

from __future__ import annotations

from typing import Any

from transports.faults.usb_kinds import USB_FAULTS
from transports.link.endpoint import EndpointFactory
from transports.link.kind import CameraFacts, LinkKind, Listener, Unsuitable, Wiring
from transports.usb.usbip.parameters import UsbipLink

__all__ = ["USBIP"]


def _endpoint(link: UsbipLink, wiring: Wiring) -> EndpointFactory[Any]:
    from transports.usb.usbip.endpoint import UsbipFactory

    return UsbipFactory(link.host, link.port, link.busid, wiring.faults, link.allow)


def _check(link: UsbipLink, camera: CameraFacts) -> None:
    """Raise Unsuitable for a camera without a USB device."""
    if camera.usb_models.get(camera.model) == camera.size:
        return
    cures = " or ".join(f'model = "{name}" with its {w}x{h} pixels' for name, (w, h) in camera.usb_models.items())
    raise Unsuitable(
        f"there is no USB model for a {camera.model} of {camera.size[0]}x{camera.size[1]} pixels yet; use {cures}, "
        'or kind = "loopback"',
        "kind",
    )


USBIP = LinkKind(
    UsbipLink,
    serves="usb",
    endpoint=_endpoint,
    faults=USB_FAULTS,
    listener=Listener("usb", "Read a DAVIS346 or an EVK4 on USB.", "emulator.cli.listen.usb:listen"),
    check=_check,
    listens_on=lambda link: (link.host, link.port) if link.port else None,
)
