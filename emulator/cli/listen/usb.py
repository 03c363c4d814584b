"""`evstim listen`: read a DAVIS346, real or emulated."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from emulator.cli.listen.limits import Limits, until
from emulator.cli.output import BAD_VERDICT, GOOD, LACKING, WRONG_USE, Failure, console, print_json, status
from transports.link.pacing import MonotonicClock
from transports.link.record import Recorder
from transports.usb.davis_host import DAVIS_PRODUCT, DAVIS_VENDOR, DavisHost
from transports.usb.host import UsbHost, UsbHostError
from transports.usb.pyusb_host import PyusbHost
from transports.usb.receiver import Reception, receive
from transports.usb.usbip.client import UsbipHost

__all__ = ["listen"]

_NO_LIMITS = Limits()


def listen(
    *,
    usbip: str | None = None,
    busid: str = "1-1",
    limits: Annotated[Limits, Parameter(name="*")] = _NO_LIMITS,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Read a DAVIS346, real or emulated, and count what arrives. Ctrl-C ends it.

    Parameters
    ----------
    usbip
        HOST:PORT of a USB/IP server, read without a kernel module. Default: this machine's first DAVIS346.
    busid
        Bus id of the camera on that server.
    limits
        When to stop, and where to keep what came.
    json
        Print one JSON object as the last line on stdout.
    """
    limits.check()
    try:
        camera = DavisHost(_host(usbip, busid))
        status.print(f"DAVIS346 serial {camera.info.serial}, {camera.info.size[0]}x{camera.info.size[1]} pixels")
        reception = _receive(camera, until(limits), limits.record)
    except UsbHostError as error:
        raise Failure(str(error), LACKING) from error
    if json:
        print_json(dataclasses.asdict(reception))
    else:
        console.print(
            f"{reception.events} events and {reception.edges} edges in {reception.seconds:.2f} s, "
            f"digest {reception.digest:08x}, {reception.faults} malformed words"
            f"{', the camera was unplugged' if reception.gone else ''}"
        )
    return BAD_VERDICT if reception.faults else GOOD


def _host(usbip: str | None, busid: str) -> UsbHost:
    if usbip is None:
        return PyusbHost.find(DAVIS_VENDOR, DAVIS_PRODUCT)
    host, _, port = usbip.rpartition(":")
    if not host or not port.isdigit():
        raise Failure(f"--usbip must be HOST:PORT such as 127.0.0.1:3240, got {usbip!r}", WRONG_USE)
    return UsbipHost.attach(host, int(port), busid, timeout_s=5.0)


def _receive(camera: DavisHost, goes_on: Callable[[Reception], bool], record: Path | None) -> Reception:
    recorder = Recorder(record) if record is not None else None
    try:
        return receive(camera, goes_on, MonotonicClock(), recorder)
    finally:
        if recorder is not None:
            recorder.close()
        camera.close()
