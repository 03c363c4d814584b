"""`evstim listen`: read a DAVIS346, real or emulated."""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from emulator.cli.output import BAD_VERDICT, GOOD, LACKING, WRONG_USE, Failure, console, print_json, status
from transports.link.pacing import MonotonicClock
from transports.link.record import Recorder
from transports.usb.davis_host import DAVIS_PRODUCT, DAVIS_VENDOR, DavisHost
from transports.usb.host import UsbHost, UsbHostError
from transports.usb.pyusb_host import PyusbHost
from transports.usb.receiver import Reception, receive
from transports.usb.usbip.client import UsbipHost

__all__ = ["listen"]

_LINE_PERIOD_S = 1.0


def listen(
    *,
    usbip: str | None = None,
    busid: str = "1-1",
    seconds: float | None = None,
    events: int | None = None,
    record: Path | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Read a DAVIS346, real or emulated, and count what arrives. Ctrl-C ends it.

    Parameters
    ----------
    usbip
        HOST:PORT of a USB/IP server, read without a kernel module. Default: this machine's first DAVIS346.
    busid
        Bus id of the camera on that server.
    seconds
        Stop after this time, seconds.
    events
        Stop after this many events.
    record
        Write the received events to this .npz (fields `events` and `edges`, device time).
    json
        Print one JSON object as the last line on stdout.
    """
    if record is not None and not record.parent.is_dir():
        raise Failure(f"--record: the folder {record.parent} does not exist", WRONG_USE)
    try:
        camera = DavisHost(_host(usbip, busid))
        status.print(f"DAVIS346 serial {camera.info.serial}, {camera.info.size[0]}x{camera.info.size[1]} pixels")
        reception = _receive(camera, _until(seconds, events), record)
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


def _until(seconds: float | None, events: int | None) -> Callable[[Reception], bool]:
    """Return a function that is False past a limit and after Ctrl-C; it prints the event rate meanwhile."""
    stopped = False
    next_line_s, before = _LINE_PERIOD_S, Reception()

    def stop(*_: object) -> None:
        nonlocal stopped
        stopped = True

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)

    def goes_on(now: Reception) -> bool:
        nonlocal next_line_s, before
        if now.seconds >= next_line_s:
            rate = (now.events - before.events) / (now.seconds - before.seconds) * 1e-6
            status.print(f"{now.seconds:7.1f} s  {now.events:>12} events  {rate:7.3f} Mev/s")
            next_line_s, before = now.seconds + _LINE_PERIOD_S, now
        in_time = seconds is None or now.seconds < seconds
        return not stopped and in_time and (events is None or now.events < events)

    return goes_on


def _receive(camera: DavisHost, goes_on: Callable[[Reception], bool], record: Path | None) -> Reception:
    recorder = Recorder(record) if record is not None else None
    try:
        return receive(camera, goes_on, MonotonicClock(), recorder)
    finally:
        if recorder is not None:
            recorder.close()
        camera.close()
