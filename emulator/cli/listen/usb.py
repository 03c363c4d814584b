"""`evstim listen`: read a DAVIS346 or an EVK4, real or emulated."""

from __future__ import annotations

from contextlib import closing
from typing import Annotated

from cyclopts import Parameter

from emulator.cli.listen.reception import Limits, Source, lacking, listen_to
from emulator.cli.output import WRONG_USE, Failure, status
from transports.link.pacing import MonotonicClock
from transports.usb.cameras import CameraReception, driver_of, first_on_the_bus, receive
from transports.usb.host import UsbHost, UsbHostError
from transports.usb.usbip.client import UsbipHost

__all__ = ["listen"]

_NO_LIMITS = Limits()
_GONE = "the camera went away before the reception was to end: it was unplugged, or its run ended or died"


def listen(
    *,
    usbip: str | None = None,
    busid: str = "1-1",
    limits: Annotated[Limits, Parameter(name="*")] = _NO_LIMITS,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Read a DAVIS346 or an EVK4, real or emulated, and count the received data. Ctrl-C ends it.

    Parameters
    ----------
    usbip
        HOST:PORT of a USB/IP server, read without a kernel module. Default: this machine's first camera.
    busid
        Bus id of the camera on that server.
    limits
        Limits of the reception, and the file for the received events.
    json
        Print one JSON object as the last line on stdout.
    """
    limits.check()
    with lacking(UsbHostError), closing(driver_of(_host(usbip, busid))) as camera:
        status.print(f"{camera.model} serial {camera.info.serial}, {camera.info.size[0]}x{camera.info.size[1]} pixels")
        source = Source(lambda goes_on, recorder: receive(camera, goes_on, MonotonicClock(), recorder), _summary, _GONE)
        return listen_to(source, limits, json=json)


def _summary(reception: CameraReception) -> list[str]:
    return [f", {reception.faults} malformed words{', the camera was unplugged' if reception.gone else ''}"]


def _host(usbip: str | None, busid: str) -> UsbHost:
    if usbip is None:
        return first_on_the_bus()
    host, _, port = usbip.rpartition(":")
    if not host or not port.isdigit():
        raise Failure(f"--usbip must be HOST:PORT such as 127.0.0.1:3240, got {usbip!r}", WRONG_USE)
    return UsbipHost.attach(host, int(port), busid, timeout_s=5.0)
