"""Event cameras that can be read on USB: the common interface of their drivers, and the driver of each device.

`receive` counts, digests and records the events of a camera until it is stopped or unplugged.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from firmware_protocol.davis346.decoder import WordFaults
from firmware_protocol.events import Edges, Events, empty_events
from transports.link.deliveries import digest_of
from transports.link.pacing import Clock
from transports.recording.part import Part
from transports.recording.record import Recorder
from transports.usb.davis_host import DAVIS_PRODUCT, DAVIS_VENDOR, DavisHost, DavisInfo, StreamSettings
from transports.usb.evk4_host import EVK4_PRODUCT, EVK4_VENDOR, Evk4Host, Evk4Info
from transports.usb.host import DeviceAbsent, PeerGone, UnsuitableDevice, UsbHost
from transports.usb.pyusb_host import PyusbHost

__all__ = ["CAMERAS", "CameraHost", "Reception", "driver_of", "first_on_the_bus", "receive"]


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
class Reception:
    """Events and counts received so far.

    Attributes
    ----------
    seconds
        Wall time since the stream was started.
    last_t_us
        Device time of the newest event; None before the first.
    digest
        Digest of all events, see `digest_of`.
    faults
        Number of words that an intact stream never contains.
    gone
        True when the camera was lost.
    edges
        Number of edges of the external input.
    """

    events: int = 0
    seconds: float = 0.0
    last_t_us: int | None = None
    digest: int = 0
    faults: int = 0
    gone: bool = False
    edges: int = 0

    def with_events(self, events: Events, edges: int = 0) -> Reception:
        """Return the reception with `events`, in device time, and a number of edges added."""
        more = dataclasses.replace(self, edges=self.edges + edges)
        if not len(events):
            return more
        return dataclasses.replace(
            more,
            events=self.events + len(events),
            last_t_us=int(events["t"][-1]),
            digest=digest_of(events, self.digest),
        )

    def at(self, seconds: float, faults: int, *, gone: bool = False) -> Reception:
        """Return the reception with the values of a later moment."""
        return dataclasses.replace(self, seconds=seconds, faults=faults, gone=gone)


def receive(
    camera: CameraHost, goes_on: Callable[[Reception], bool], clock: Clock, recorder: Recorder | None = None
) -> Reception:
    """Start the camera and read it while `goes_on`, called after each transfer, returns True; then stop it.

    The loss of the camera ends it too. Raises UsbHostError when the camera cannot be started.
    """
    reception = Reception()
    start_ns = clock.now_ns()

    def take(events: Events | None) -> None:
        nonlocal reception
        events, edges = empty_events() if events is None else events, camera.take_edges()
        reception = reception.with_events(events, len(edges))
        if recorder is not None and (len(events) or len(edges)):
            recorder.append(Part(events, edges))
        reception = reception.at((clock.now_ns() - start_ns) * 1e-9, camera.faults.total)

    camera.start(StreamSettings(edges=True))
    try:
        while goes_on(reception):
            take(camera.read(_READ_TIMEOUT_S))
        take(camera.stop())
    except PeerGone:
        return reception.at(reception.seconds, camera.faults.total, gone=True)
    return reception
