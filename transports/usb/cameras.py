"""Event cameras that can be read on USB: the common interface of their drivers, and the driver of each device.

`receive` counts, digests and records the events of a camera until it is stopped or unplugged.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from firmware_protocol.davis346.decoder import WordFaults
from firmware_protocol.events import Edges, Events, empty_events
from transports.link import reception
from transports.link.pacing import Clock
from transports.link.reception import Arrivals, Reception
from transports.recording.record import Recorder
from transports.usb.davis_host import DAVIS_PRODUCT, DAVIS_VENDOR, DavisHost, DavisInfo, StreamSettings
from transports.usb.evk4_host import EVK4_PRODUCT, EVK4_VENDOR, Evk4Host, Evk4Info
from transports.usb.host import DeviceAbsent, PeerGone, UnsuitableDevice, UsbHost
from transports.usb.pyusb_host import PyusbHost

__all__ = ["CAMERAS", "CameraHost", "CameraReception", "driver_of", "first_on_the_bus", "receive"]


class CameraHost(Protocol):
    """Driver of one camera; see `DavisHost` and `Evk4Host`."""

    @property
    def model(self) -> str:
        """Name of the camera's model."""

    @property
    def info(self) -> DavisInfo | Evk4Info:
        """Identity that the camera reports."""

    @property
    def faults(self) -> WordFaults:
        """Counts of words that an intact stream never contains."""

    def start(self, settings: StreamSettings | None = None) -> None:
        """Start the stream of events."""

    def read(self, timeout_s: float) -> Events | None:
        """Return the events of the next transfer; None when none arrived in time."""

    def take_edges(self) -> Edges:
        """Return the edges read since the last call."""

    def stop(self) -> Events:
        """Stop the camera; return the events that were still in transit."""

    def close(self) -> None:
        """Stop the camera and close it."""


CAMERAS: Mapping[tuple[int, int], Callable[[UsbHost], CameraHost]] = {
    (DAVIS_VENDOR, DAVIS_PRODUCT): DavisHost,
    (EVK4_VENDOR, EVK4_PRODUCT): Evk4Host,
}
"""Drivers by (vendor, product)."""


def driver_of(host: UsbHost) -> CameraHost:
    """Return the driver of a device; if there is none, close the device and raise UnsuitableDevice."""
    identity = host.identity
    driver = CAMERAS.get((identity.vendor_id, identity.product_id))
    if driver is None:
        host.close()
        known = " or ".join(f"{vendor:04x}:{product:04x}" for vendor, product in CAMERAS)
        raise UnsuitableDevice(f"{identity.vendor_id:04x}:{identity.product_id:04x} is not a known camera ({known})")
    return driver(host)


def first_on_the_bus() -> UsbHost:
    """Return this machine's first known camera; raises the errors of `PyusbHost.find`."""
    *others, last = CAMERAS
    for vendor, product in others:
        with contextlib.suppress(DeviceAbsent):
            return PyusbHost.find(vendor, product)
    return PyusbHost.find(*last)


_READ_TIMEOUT_S = 0.1


@dataclass(frozen=True)
class CameraReception(Reception):
    """Events and edges of the external input received so far from a camera, in device time.

    Attributes
    ----------
    faults
        Number of words that an intact stream never contains.
    """

    faults: int = 0

    @property
    def fault_count(self) -> int:
        """Number of faults."""
        return self.faults


def receive(
    camera: CameraHost, goes_on: Callable[[CameraReception], bool], clock: Clock, recorder: Recorder | None = None
) -> CameraReception:
    """Start the camera and read it while `goes_on`, called after each transfer, returns True; then stop it.

    The loss of the camera ends it too. Raises UsbHostError when the camera cannot be started.
    """
    arrivals = Arrivals(clock, recorder)

    def now(*, gone: bool = False) -> CameraReception:
        return arrivals.reception(CameraReception, gone=gone, faults=camera.faults.total)

    def take(events: Events | None) -> None:
        arrivals.add(empty_events() if events is None else events, camera.take_edges(), clock.now_ns())

    camera.start(StreamSettings(edges=True))
    gone = reception.receive(
        now, goes_on, lambda: take(camera.read(_READ_TIMEOUT_S)), stop=lambda: take(camera.stop()), lost=PeerGone
    )
    return now(gone=gone)
