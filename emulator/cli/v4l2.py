"""`evstim v4l2`: a Prophesee camera on USB as a sensor on Linux's camera interface, as payload computers read it."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from contextlib import closing
from threading import Event

from emulator.cli.listen.cameras import usb_camera
from emulator.cli.output import (
    BAD_VERDICT,
    GOOD,
    LACKING,
    WRONG_USE,
    Failure,
    Json,
    failing,
    print_result,
    status,
)
from emulator.cli.signals import stop_on_signals
from transports.usb.host import UsbHostError
from transports.usb.treuzell_host import TreuzellHost
from transports.usb.v4l2_node import MODULE_FILE, Forwarded, Node, NodeError, opened

_LINE_PERIOD_S = 1.0
_GONE = "the camera went away: it was unplugged, or its run ended or died"


def v4l2(
    *,
    usbip: str | None = None,
    busid: str = "1-1",
    buffer_kib: int = 256,
    file: str = MODULE_FILE,
    seconds: float | None = None,
    json: Json = False,
) -> int:
    """Show an EVK4 or a GenX320, real or emulated, as /dev/mediaN, /dev/videoN and a subdevice, until Ctrl-C.

    It needs the kernel module evstim_v4l2 on this machine, and root; see docs/cameras.md. Words go to the program that
    reads the video device, and its settings to the camera.

    Parameters
    ----------
    usbip
        HOST:PORT of a USB/IP server, read without a kernel module. Default: this machine's first camera.
    busid
        Bus id of the camera on that server.
    buffer_kib
        Size of the client's buffers, KiB: 4 to 16384.
    file
        The module's file.
    seconds
        End after this time, seconds.
    """
    if not 4 <= buffer_kib <= 16384:
        raise Failure(f"--buffer-kib must be 4 to 16384, got {buffer_kib}", WRONG_USE)
    with failing(LACKING, UsbHostError, NodeError), usb_camera(usbip, busid) as camera:
        if not isinstance(camera, TreuzellHost):
            raise Failure(f"{camera.model}: no driver on V4L2 is known for it", WRONG_USE)
        with closing(Node(camera, opened(file), 1024 * buffer_kib)) as node:
            status.print(f"{camera.model} serial {camera.info.serial} is the sensor {node.sensor.name}; Ctrl-C ends it")
            started_s = time.monotonic()
            node.run(_until(started_s, seconds))
    counts = node.counts
    line = (
        f"{counts.octets} bytes in {counts.buffers} buffers, {counts.streams} streams, {counts.settings} settings "
        f"in {time.monotonic() - started_s:.1f} s"
    )
    print_result(json, dataclasses.asdict(counts), [line])
    if counts.gone:
        status.print(f"evstim: {_GONE}")
    return BAD_VERDICT if counts.gone else GOOD


def _until(started_s: float, seconds: float | None) -> Callable[[Forwarded], bool]:
    """Return a function that is False past a time and after Ctrl-C; it prints the counts meanwhile."""
    stopped = Event()
    stop_on_signals(stopped.set)
    next_line_s, before = _LINE_PERIOD_S, 0

    def goes_on(counts: Forwarded) -> bool:
        nonlocal next_line_s, before
        now_s = time.monotonic() - started_s
        if now_s >= next_line_s and counts.octets != before:
            status.print(f"{now_s:7.1f} s  {counts.octets:>12} bytes  {counts.streams} streams")
            next_line_s, before = now_s + _LINE_PERIOD_S, counts.octets
        return not stopped.is_set() and (seconds is None or now_s < seconds)

    return goes_on
