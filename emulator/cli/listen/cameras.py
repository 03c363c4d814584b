"""`evstim listen` and its commands, one for each kind of link: here those of cameras on USB and GigE Vision."""

from __future__ import annotations

from contextlib import closing
from typing import Any

from cyclopts import App

from emulator.cli.listen import NO_LIMITS, Limits, Source, listen_to
from emulator.cli.output import LACKING, WRONG_USE, Failure, Json, failing, parsed_address, status
from emulator.rig.kinds import LINKS
from firmware_protocol.gige.gvcp import GVCP_PORT
from firmware_protocol.gige.gvsp import LEAST_PACKET, MOST_PACKET
from transports.gige.host import GigeHost, GigeHostError, GigeReception
from transports.gige.host import receive as receive_gige
from transports.link.pacing import MonotonicClock
from transports.reception import Reception
from transports.usb.cameras import driver_of, first_on_the_bus, receive
from transports.usb.host import CameraHost, UsbHostError
from transports.usb.usbip.client import UsbipHost

_USB_GONE = "the camera went away before the reception was to end: it was unplugged, or its run ended or died"


def usb_camera(usbip: str | None, busid: str) -> closing[CameraHost[Any]]:
    """Return the camera of a USB/IP server at HOST:PORT, or this machine's first one, to be closed."""
    if usbip is None:
        return closing(driver_of(first_on_the_bus()))
    return closing(driver_of(UsbipHost.attach(*parsed_address("--usbip", usbip), busid, timeout_s=5.0)))


def listen(*, usbip: str | None = None, busid: str = "1-1", limits: Limits = NO_LIMITS, json: Json = False) -> int:
    """Read a camera on USB, real or emulated, and count its data. Ctrl-C ends it.

    Parameters
    ----------
    usbip
        HOST:PORT of a USB/IP server, read without a kernel module. Default: this machine's first camera.
    busid
        Bus id of the camera on that server.
    """
    limits.check()
    with failing(LACKING, UsbHostError), usb_camera(usbip, busid) as camera:
        status.print(f"{camera.model} serial {camera.info.serial}, {camera.info.size[0]}x{camera.info.size[1]} pixels")

        def summary(reception: Reception) -> list[str]:
            return [f", {reception.faults} malformed words{', the camera was unplugged' if reception.gone else ''}"]

        source = Source(lambda goes_on, to: receive(camera, goes_on, MonotonicClock(), to), summary, _USB_GONE)
        return listen_to(source, limits, json=json)


_GIGE_GONE = "the camera went away before the reception was to end: its run ended or died, or another host took control"


def gige(
    at: str = "127.0.0.1:3956", /, *, packet_size: int = 1400, limits: Limits = NO_LIMITS, json: Json = False
) -> int:
    """Read a GigE Vision event camera, and count the losses. Ctrl-C ends it.

    Parameters
    ----------
    at
        ADDRESS or ADDRESS:PORT of the camera.
    packet_size
        Octets of a packet with the headers of IP and UDP: 576 to 9000, even; no more than the network's MTU.
    """
    limits.check()
    if not LEAST_PACKET <= packet_size <= MOST_PACKET or packet_size % 2:
        raise Failure(f"--packet-size must be even, {LEAST_PACKET} to {MOST_PACKET}, got {packet_size}", WRONG_USE)
    host, port = parsed_address("AT", at if ":" in at else f"{at}:{GVCP_PORT}")
    clock = MonotonicClock()
    with failing(LACKING, GigeHostError), closing(GigeHost(host, port, now_ns=clock.now_ns)) as camera:
        about = camera.identity
        status.print(f"{about.manufacturer} {about.model} serial {about.serial}")

        def summary(reception: GigeReception) -> list[str]:
            return [f", {reception.blocks_lost} blocks lost, {reception.packets_requested} packets requested again"]

        source = Source(lambda goes_on, to: receive_gige(camera, packet_size, goes_on, clock, to), summary, _GIGE_GONE)
        return listen_to(source, limits, json=json)


_LISTENERS = [kind.listener for kind in LINKS.usable().values() if kind.listener is not None]

verbs = App(name="listen")
verbs.default(listen)
for _verb, _listener in {listener.verb: listener for listener in reversed(_LISTENERS)}.items():  # the first of a verb
    verbs.command(_listener.path, name=_verb, help=_listener.help)
