"""The event cameras that can be read on USB: what their drivers have in common, and which driver a device needs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Protocol

from firmware_protocol.davis346.decoder import WordFaults
from firmware_protocol.edges import Edges
from firmware_protocol.events import Events
from transports.usb.davis_host import DAVIS_PRODUCT, DAVIS_VENDOR, DavisHost, DavisInfo, StreamSettings
from transports.usb.evk4_host import EVK4_PRODUCT, EVK4_VENDOR, Evk4Host, Evk4Info
from transports.usb.host import DeviceAbsent, UnsuitableDevice, UsbHost
from transports.usb.pyusb_host import PyusbHost

__all__ = ["CAMERAS", "CameraHost", "driver_of", "first_on_the_bus"]


class CameraHost(Protocol):
    """A driver of one camera; see `DavisHost` and `Evk4Host`."""

    @property
    def model(self) -> str:
        """Name of the camera's model."""

    @property
    def info(self) -> DavisInfo | Evk4Info:
        """What the camera says of itself."""

    @property
    def faults(self) -> WordFaults:
        """Words that a healthy stream does not hold."""

    def start(self, settings: StreamSettings | None = None) -> None:
        """Let events flow."""

    def read(self, timeout_s: float) -> Events | None:
        """Return the events of the next transfer; None when none came in time."""

    def take_edges(self) -> Edges:
        """Return the edges read since the last call."""

    def stop(self) -> Events:
        """Stop the camera; gives the events that were still under way."""

    def close(self) -> None:
        """Stop the camera and let go of it."""


CAMERAS: Mapping[tuple[int, int], Callable[[UsbHost], CameraHost]] = {
    (DAVIS_VENDOR, DAVIS_PRODUCT): DavisHost,
    (EVK4_VENDOR, EVK4_PRODUCT): Evk4Host,
}
"""Drivers by (vendor, product)."""


def driver_of(host: UsbHost) -> CameraHost:
    """Return the driver of a device; raises UnsuitableDevice, having closed it, where there is none."""
    identity = host.identity
    driver = CAMERAS.get((identity.vendor_id, identity.product_id))
    if driver is None:
        host.close()
        known = " or ".join(f"{vendor:04x}:{product:04x}" for vendor, product in CAMERAS)
        raise UnsuitableDevice(f"{identity.vendor_id:04x}:{identity.product_id:04x} is not a known camera ({known})")
    return driver(host)


def first_on_the_bus() -> UsbHost:
    """Return this machine's first known camera; raises what `PyusbHost.find` raises."""
    *others, last = CAMERAS
    for vendor, product in others:
        with contextlib.suppress(DeviceAbsent):
            return PyusbHost.find(vendor, product)
    return PyusbHost.find(*last)
