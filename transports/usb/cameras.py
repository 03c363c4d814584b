"""Event cameras that can be read on USB: the driver of each device, imported when one is opened.

A package outside evstim provides the driver of its camera as an entry point of the group "evstim.usb_drivers", under
the numbers of vendor and product, such as "152a:841a".

`receive` counts, digests and records the events of a camera until it is stopped or unplugged.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import Any, cast

from firmware_protocol.events import Events, empty_events
from transports import reception
from transports.link.pacing import Clock
from transports.reception import Arrivals, Reception
from transports.recording.record import Recorder
from transports.registry import imported
from transports.usb.host import CameraHost, DeviceAbsent, PeerGone, StreamSettings, UnsuitableDevice, UsbHost
from transports.usb.pyusb_host import PyusbHost

_GROUP = "evstim.usb_drivers"
DRIVERS: Mapping[tuple[int, int], str] = {
    (0x152A, 0x841A): "transports.usb.davis_host:DavisHost",
    (0x152A, 0x841B): "transports.usb.davis_host:Davis240cHost",
    (0x152A, 0x8419): "transports.usb.dvxplorer_host:driver_of_model",
    (0x04B4, 0x00F5): "transports.usb.treuzell_host:TreuzellHost",
    (0x1409, 0x8E00): "transports.usb.treuzell_host:TreuzellHost",
    (0x31F7, 0x0002): "transports.usb.treuzell_host:TreuzellHost",
    (0x31F7, 0x0003): "transports.usb.treuzell_host:TreuzellHost",
    (0x31F7, 0x0004): "transports.usb.treuzell_host:TreuzellHost",
}
"""Import path, "module:name", of the function or class that makes the driver of a `UsbHost`, by (vendor, product)."""


def driver_of(host: UsbHost) -> CameraHost[Any]:
    """Return the driver of a device; if there is none, close the device and raise UnsuitableDevice."""
    usb_id = host.identity.vendor_id, host.identity.product_id
    name = "{:04x}:{:04x}".format(*usb_id)
    path = DRIVERS.get(usb_id) or next((point.value for point in entry_points(group=_GROUP, name=name)), None)
    if path is None:
        host.close()
        cameras = " or ".join(f"{vendor:04x}:{product:04x}" for vendor, product in DRIVERS)
        raise UnsuitableDevice(f"{name} is not a known camera ({cameras})")
    return cast(CameraHost[Any], imported(path)(host))


def first_on_the_bus() -> UsbHost:
    """Return this machine's first known camera, or one with an installed driver; raises as `PyusbHost.find` does."""
    names = [point.name for point in entry_points(group=_GROUP) if re.fullmatch(r"[0-9a-f]{4}:[0-9a-f]{4}", point.name)]
    *earlier, last = [*((int(name[:4], 16), int(name[5:], 16)) for name in names), *DRIVERS]
    for vendor, product in earlier:
        with contextlib.suppress(DeviceAbsent):
            return PyusbHost.find(vendor, product)
    return PyusbHost.find(*last)


_READ_TIMEOUT_S = 0.1


def receive(
    camera: CameraHost[Any], goes_on: Callable[[Reception], bool], clock: Clock, recorder: Recorder | None = None
) -> Reception:
    """Start the camera and read it while `goes_on`, called after each transfer, returns True; then stop it.

    The loss of the camera ends it too. Raises UsbHostError when the camera cannot be started.
    """
    arrivals = Arrivals(clock, recorder)

    def now(*, gone: bool = False) -> Reception:
        return arrivals.reception(Reception, gone=gone, faults=camera.faults.total)

    def take(events: Events | None) -> None:
        arrivals.add(empty_events() if events is None else events, camera.take_edges(), clock.now_ns())

    camera.start(StreamSettings(edges=True))
    gone = reception.receive(
        now, goes_on, lambda: take(camera.read(_READ_TIMEOUT_S)), stop=lambda: take(camera.stop()), lost=PeerGone
    )
    return now(gone=gone)
